"""How Taichi's Python reads our functions: in less time than it takes by itself, into the same statements.

Taichi expands every call of a ti.func, and each time looks for its source and draws pictures of its lines for errors that do not
happen. Here this is done once, or not at all, while a kernel of ours compiles, and only then: what the user compiles in the same
process is compiled as ever.

Everything here knows the inside of Taichi 1.7.4; with another one, functions are read as Taichi does.
"""

import ast
import contextlib
import linecache
import sys
import textwrap
import weakref
from functools import cache
from types import CodeType, SimpleNamespace
from typing import Any

from taichi.lang import impl, kernel_impl, matrix, snode
from taichi.lang.ast import ASTTransformerContext

from ..language import HOME, OURS, TAICHI, active

CLOSING = (")", "]", "}")  # what the last lines of a function may begin with that are not in its code
PLAIN = ("ctx", "op", "ops", "id", "attr", "arg", "name", "names", "type_comment")  # what nodes have that is no node of a tree
NOTHING = 8  # bytes of code of a function that has nothing but a docstring
_lines: weakref.WeakKeyDictionary = weakref.WeakKeyDictionary()  # of functions, as inspect finds them
_trees: weakref.WeakKeyDictionary = weakref.WeakKeyDictionary()  # of functions: those that are not in use


def _lines_of(function) -> tuple[list[str], int]:
    """The source of a function that is about to be compiled, found once and not at each call of it."""
    if not active:
        return _find_lines(function)
    if function not in _lines:
        _lines[function] = _cut_out(function.__code__) or _find_lines(function)
    return _lines[function]


def _cut_out(code: CodeType) -> tuple[list[str], int] | None:
    """The lines of a function from where its code begins to where it ends; inspect looks for the end token by token."""
    first, end, lines = code.co_firstlineno, _end(code), linecache.getlines(code.co_filename)
    while lines[end : end + 1] and lines[end].lstrip().startswith(CLOSING):
        end += 1
    if len(code.co_code) <= NOTHING:  # its code does not tell where the docstring ends
        end = next((k for k in range(end, len(lines) + 1) if _whole(lines[first - 1 : k])), 0)
    return (lines[first - 1 : end], first) if lines and end else None


def _whole(lines: list[str]) -> bool:
    """Whether they make up a function."""
    with contextlib.suppress(SyntaxError):
        return bool(ast.parse(textwrap.dedent("".join(lines))))
    return False


def _end(code: CodeType) -> int:
    """The last line of a function and of those inside it."""
    inside = [_end(const) for const in code.co_consts if isinstance(const, CodeType)]
    if code.co_filename.startswith(OURS):  # ours end with a line that does something, or with brackets that close
        return max(code.co_firstlineno, *inside, *(line for _, _, line in code.co_lines() if line))
    return max([code.co_firstlineno, *inside, *(end for _, end, _, _ in code.co_positions() if end)])


def _filled(line: str, tabsize: int, width: int) -> str:
    """A line without tabs and the like, and without space at its end."""
    if line[:-1].isprintable() and len(line) < width:
        return line.rstrip()
    return textwrap.fill(line, tabsize=tabsize, width=width)


def _dedented(text: str) -> str:
    """Lines without the space that all begin with, which is nearly always that of the first one."""
    margin = text[: len(text) - len(text.lstrip())]
    if all(line.startswith(margin) for line in text.split("\n") if line):
        return text.removeprefix(margin).replace("\n" + margin, "\n")
    return textwrap.dedent(text)


def _place_of(self: Any, node: Any) -> str:
    """Where a node is, without the picture of it that Taichi draws for every node; errors still get it."""
    if not active or self.raised:
        return _draw(self, node)
    if node.lineno != self.line:
        line, name = self.src[node.lineno - 1], self.func.func.__name__
        self.line, self.place = node.lineno, f'File "{self.file}", line {node.lineno + self.lineno_offset}, in {name}:\n{line}\n'
    return self.place


def _read(self: Any, *more: Any, is_kernel: bool = True, is_real_function: bool = False, **options: Any) -> Any:
    """The tree of a function, and what it is compiled in: a tree that was read before and is not in use, see _transformed(). What
    calls it may be a function itself, see calls.py; Taichi thinks of kernels alone."""
    if options.get("ast_builder") is not None:
        runtime: Any = impl.get_runtime()
        options["ast_builder"] = runtime.compiling_callable.ast_builder()
    spare = _trees.get(self.func) if active and not (is_kernel or is_real_function or more) else None
    if not spare:
        return _parse(self, *more, is_kernel=is_kernel, is_real_function=is_real_function, **options)
    tree = spare.pop()
    around = {"func": self, "global_vars": kernel_impl._get_global_vars(self.func), "argument_data": options["args"]}
    return tree, ASTTransformerContext(is_kernel=False, ast_builder=options["ast_builder"], **around, **tree.source)


def _transformed(tree: Any, ctx: Any) -> Any:
    """Make statements of a tree. That of a ti.func is kept for the next call of it, without what its nodes came to."""
    out = _transform(tree, ctx)
    if active and not ctx.is_kernel and not ctx.is_real_function:
        if not hasattr(tree, "nodes"):
            tree.nodes = _nodes(tree)
            tree.source = {"src": ctx.src, "start_lineno": ctx.lineno_offset + 1, "file": ctx.file}
        for node in tree.nodes:
            node.__dict__.pop("ptr", None)
            node.__dict__.pop("caller", None)
        _trees.setdefault(ctx.func.func, []).append(tree)
    return out


@cache
def _inside(kind: type) -> tuple[str, ...]:
    """Where nodes of a kind have others, and not a text, a number or the name of an operation."""
    return () if kind is ast.Constant else tuple(name for name in kind._fields if name not in PLAIN)  # type: ignore[attr-defined]


def _nodes(tree: Any) -> list[Any]:
    """The nodes of a tree that come to something; ast.walk takes twice the time."""
    nodes = [tree]
    for node in nodes:
        known = node.__dict__
        for name in _inside(type(node)):
            value = known[name]
            if type(value) is list:
                nodes += [one for one in value if isinstance(one, ast.AST)]
            elif isinstance(value, ast.AST):
                nodes.append(value)
    return nodes


def _in_class(level_of_class_stackframe: int) -> bool:
    """Whether a decorator is at work in the body of a class; Taichi looks for the source of the statement around it, which for
    all of ours took half of the time that importing them took."""
    body = sys._getframe(level_of_class_stackframe - 1)
    if body.f_code.co_filename.startswith(HOME):
        return "__qualname__" in body.f_locals
    return _look_around(level_of_class_stackframe + 1)


def _trace(stacklevel: int = 1) -> str:
    """Who declares a field, for errors that ours do not make; finding out took longer than declaring it."""
    frame: Any = sys._getframe(1)
    while frame and frame.f_code.co_filename.startswith(TAICHI):
        frame = frame.f_back
    return "" if frame and frame.f_code.co_filename.startswith(OURS) else _who(stacklevel + 1)


def apply() -> None:
    """Put these in the place of what Taichi calls."""
    kernel_impl.getsourcelines, kernel_impl._inside_class = _lines_of, _in_class
    kernel_impl.textwrap = SimpleNamespace(fill=_filled, dedent=_dedented)
    kernel_impl._get_tree_and_ctx, kernel_impl.transform_tree = _read, _transformed
    context: Any = ASTTransformerContext
    context.get_pos_info, context.line, context.place = _place_of, 0, ""
    impl.get_traceback = matrix.get_traceback = snode.get_traceback = _trace


_find_lines: Any = kernel_impl.getsourcelines
_look_around: Any = kernel_impl._inside_class
_parse: Any = kernel_impl._get_tree_and_ctx
_transform: Any = kernel_impl.transform_tree
_draw: Any = ASTTransformerContext.get_pos_info
_who: Any = snode.get_traceback
