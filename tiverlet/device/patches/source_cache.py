"""How Taichi's Python reads tiverlet's functions: in less time than by itself, into the same statements.

Taichi expands every call of a ti.func. Each time it searches for the source and formats source excerpts for errors that do not
occur. Here this happens once, or not at all, while a kernel of tiverlet compiles, and only then; kernels that the user compiles
in the same process are not affected.
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

CLOSING = (")", "]", "}")  # last lines of a function that its code object may not count begin with one of these
PLAIN = ("ctx", "op", "ops", "id", "attr", "arg", "name", "names", "type_comment")  # attributes of nodes without nodes in them
NOTHING = 8  # bytes of code of a function with only a docstring
_lines: weakref.WeakKeyDictionary = weakref.WeakKeyDictionary()  # source lines by function, as from inspect
_trees: weakref.WeakKeyDictionary = weakref.WeakKeyDictionary()  # parsed trees by function that are not in use


def _lines_of(function) -> tuple[list[str], int]:
    """Return the source of a function to compile, found once and not at each call."""
    if not active:
        return _find_lines(function)
    if function not in _lines:
        _lines[function] = _cut_out(function.__code__) or _find_lines(function)
    return _lines[function]


def _cut_out(code: CodeType) -> tuple[list[str], int] | None:
    """Return the lines of a function from its code's first line to its last; inspect finds the end token by token."""
    first, end, lines = code.co_firstlineno, _end(code), linecache.getlines(code.co_filename)
    while lines[end : end + 1] and lines[end].lstrip().startswith(CLOSING):
        end += 1
    if len(code.co_code) <= NOTHING:  # the code does not contain the last line of the docstring
        end = next((k for k in range(end, len(lines) + 1) if _whole(lines[first - 1 : k])), 0)
    return (lines[first - 1 : end], first) if lines and end else None


def _whole(lines: list[str]) -> bool:
    """Whether lines form a complete function."""
    with contextlib.suppress(SyntaxError):
        return bool(ast.parse(textwrap.dedent("".join(lines))))
    return False


def _end(code: CodeType) -> int:
    """Return the last line of a function and of the functions inside it."""
    inside = [_end(const) for const in code.co_consts if isinstance(const, CodeType)]
    if code.co_filename.startswith(OURS):  # tiverlet's functions end with a line of code, or with closing brackets
        return max(code.co_firstlineno, *inside, *(line for _, _, line in code.co_lines() if line))
    return max([code.co_firstlineno, *inside, *(end for _, end, _, _ in code.co_positions() if end)])


def _filled(line: str, tabsize: int, width: int) -> str:
    """Return a line without tabs and other whitespace characters, and without trailing space, as textwrap.fill does."""
    if line[:-1].isprintable() and len(line) < width:
        return line.rstrip()
    return textwrap.fill(line, tabsize=tabsize, width=width)


def _dedented(text: str) -> str:
    """Return text without common leading space, nearly always that of the first line, as textwrap.dedent does."""
    margin = text[: len(text) - len(text.lstrip())]
    if all(line.startswith(margin) for line in text.split("\n") if line):
        return text.removeprefix(margin).replace("\n" + margin, "\n")
    return textwrap.dedent(text)


def _place_of(self: Any, node: Any) -> str:
    """Return file and line of a node, without the excerpt that Taichi formats for every node; errors still show it."""
    if not active or self.raised:
        return _draw(self, node)
    if node.lineno != self.line:
        line, name = self.src[node.lineno - 1], self.func.func.__name__
        self.line, self.place = node.lineno, f'File "{self.file}", line {node.lineno + self.lineno_offset}, in {name}:\n{line}\n'
    return self.place


def _read(self: Any, *more: Any, is_kernel: bool = True, is_real_function: bool = False, **options: Any) -> Any:
    """Return the tree of a function and its context. Reuse a tree that was parsed before and is not in use, see _transformed().

    The caller may itself be a called function, see calls.py; Taichi expects a kernel.
    """
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
    """Translate a tree into statements. The tree of a ti.func is kept for its next call, without the results of its nodes."""
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
    """Return the attributes of a kind of node that hold nodes, not a text, a number or an operator."""
    return () if kind is ast.Constant else tuple(name for name in kind._fields if name not in PLAIN)  # type: ignore[attr-defined]


def _nodes(tree: Any) -> list[Any]:
    """Return all nodes of a tree that get a result; ast.walk takes twice the time."""
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
    """Whether a decorator runs in the body of a class.

    Taichi searches for the source of the statement around it, which for all of tiverlet's classes takes half of the import time.
    """
    body = sys._getframe(level_of_class_stackframe - 1)
    if body.f_code.co_filename.startswith(HOME):
        return "__qualname__" in body.f_locals
    return _look_around(level_of_class_stackframe + 1)


def _trace(stacklevel: int = 1) -> str:
    """Return which code declares a field, for error messages.

    Fields of tiverlet skip this search, which takes longer than declaring them.
    """
    frame: Any = sys._getframe(1)
    while frame and frame.f_code.co_filename.startswith(TAICHI):
        frame = frame.f_back
    return "" if frame and frame.f_code.co_filename.startswith(OURS) else _who(stacklevel + 1)


def apply() -> None:
    """Replace Taichi's functions by these."""
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
