"""How Taichi's Python makes statements of the trees of our functions: in three quarters of the time that it takes by itself, the
same statements.

At each node Taichi asks again what it has asked before: where it is, how Taichi was started, which of a dozen kinds of values it
has. Here this is asked once, or first about the few kinds that our kernels are made of; all others go the way that Taichi made,
and so does all that the user compiles in the same process.

Everything here knows the inside of Taichi 1.7.4; with another one, statements are made as Taichi does.
"""

import ast
import operator
from functools import cache, lru_cache
from typing import Any

from taichi._lib import core
from taichi.lang import impl
from taichi.lang.any_array import AnyArray
from taichi.lang.ast import ast_transformer
from taichi.lang.ast.ast_transformer import ASTTransformer
from taichi.lang.ast.ast_transformer_utils import LoopStatus, ReturnStatus
from taichi.lang.expr import Expr
from taichi.lang.field import ScalarField
from taichi.lang.matrix import MatrixField

from ..language import active, ti

PLACES = 1000  # lines of code that are kept as what Taichi tells its compiler about where things are
INT = range(-(2**31), 2**31)  # what a literal may be without a type of its own
BUILTINS = {id(f) for f in (print, min, max, int, bool, float, any, all, abs, pow, len, operator.matmul)}  # that Taichi replaces


def _decorated(ctx: Any, node: Any) -> str:
    """Which of Taichi's own a call is; it is asked for every call, and again for every turn of a static loop."""
    if not active:
        return _decorator(ctx, node)
    if not hasattr(node, "decorator"):
        node.decorator = _decorator(ctx, node)
    return node.decorator


@cache
def _method(kind: type) -> Any:
    return getattr(ASTTransformer, f"build_{kind.__name__}", None)


class _Failed:
    """In the place of what compiles nodes: it fails with an error that is there already."""

    def __init__(self, error: Exception):
        self._error = error

    def __getattr__(self, name: str) -> Any:
        def fail(ctx, node):
            """Raise what went wrong when the tree was read."""
            raise self._error

        return fail


def _visited(self: Any, ctx: Any, node: Any) -> Any:
    """Compile a node. Taichi works out anew for each where it is, which takes as long as all else that it does in Python."""
    kind = type(node)
    method = _method(kind)
    if not active or method is None:
        return _visit(self, ctx, node)
    if kind is ast.Name:  # as every third is; errors in what it stands for say where they are themselves
        for names in reversed(ctx.local_scopes):
            if node.id in names:
                node.ptr = names[node.id]
                return node.ptr
    if kind is ast.Attribute:
        node.__dict__.pop("caller", None)  # from the last time
    places = impl.pytaichi.src_info_stack
    places.append(ctx.get_pos_info(node) if hasattr(node, "lineno") else ctx.place)
    try:
        return method(ctx, node)
    except Exception as e:
        return _visit(_Failed(e), ctx, node)  # which says where, as ever
    finally:
        places.pop()


def _statements(ctx: Any, nodes: Any) -> Any:
    """Compile nodes one after the other, as far as a `return`, and a `break` or `continue` of a static loop."""
    if not active:
        return _build_all(ctx, nodes)
    ctx.local_scopes.append({})
    try:
        for node in nodes:
            if ctx.returned != ReturnStatus.NoReturn or ctx.loop_scopes and ctx.loop_scopes[-1].status != LoopStatus.Normal:
                break
            _build(ctx, node)
    finally:
        ctx.local_scopes.pop()
    return nodes


def _builtin(ctx: Any, node: Any, args: Any, keywords: Any) -> bool:
    """Whether a call is of what Python has built in; Taichi makes a dictionary of it for every call."""
    return id(node.func.ptr) in BUILTINS and _call_builtin(ctx, node, args, keywords)


def _express(self: Any, *args: Any, dbg_info: Any = None, dtype: Any = None) -> None:
    """An expression from one of the compiler's, from another one or from a number."""
    if not active or dtype is not None or len(args) != 1:
        return _init(self, *args, dbg_info=dbg_info, dtype=dtype)
    kind, new = type(args[0]), args[0]
    if kind is Expr:
        self.ptr, self.dbg_info, self.ptr_type_checked = new.ptr, new.dbg_info, True
        return None
    if kind is int and new in INT and impl.pytaichi.default_ip is ti.i32:
        new = core.make_const_expr_int(ti.i32, new)
    elif kind is float:
        new = core.make_const_expr_fp(impl.pytaichi.default_fp, new)
    elif kind is not core.Expr:
        return _init(self, *args, dbg_info=dbg_info)
    self.ptr, self.dbg_info, self.ptr_type_checked = new, dbg_info, True
    if dbg_info:
        new.set_dbg_info(dbg_info)
    new.type_check(active[-1].config)
    return None


def _variable(value: Any) -> Any:
    """A variable with this value; most are single expressions, which Taichi finds out last."""
    if not active or type(value) is not Expr:
        return _declare(value)
    runtime: Any = impl.pytaichi
    builder = runtime.compiling_callable.ast_builder()
    return Expr(builder.expr_var(value.ptr, core.DebugInfo(runtime.src_info_stack[-1])))


def _subscript(builder: Any, value: Any, *indices: Any, **options: Any) -> Any:
    """value[indices]; quickly where these are expressions and numbers."""
    plain = active and indices and all(type(k) is Expr or type(k) is int and k >= 0 for k in indices)
    target = _target(value) if plain else None
    if target is None:
        return _at(builder, value, *indices, **options)
    runtime: Any = impl.pytaichi
    group = core.ExprGroup()
    for k in indices:
        group.push_back((k if type(k) is Expr else Expr(k)).ptr)
    builder = runtime.compiling_callable.ast_builder()
    return Expr(builder.expr_subscript(target, group, core.DebugInfo(runtime.src_info_stack[-1])))


def _target(value: Any) -> Any:
    """What the compiler takes for a field, an array or a vector; None for all else."""
    kind = type(value)
    if kind is ScalarField:
        return value.vars[0].ptr
    return value.ptr if kind in (MatrixField, AnyArray) or kind is Expr and value.is_tensor() else None


def apply() -> None:
    """Put these in the place of what Taichi calls."""
    core.DebugInfo = lru_cache(PLACES)(core.DebugInfo)
    Expr.__init__, impl.expr_init, impl.subscript = _express, _variable, _subscript
    ASTTransformer.__call__, ASTTransformer.get_decorator = _visited, staticmethod(_decorated)
    ASTTransformer.build_call_if_is_builtin, ast_transformer.build_stmts = staticmethod(_builtin), _statements


_visit: Any = ASTTransformer.__call__
_decorator: Any = ASTTransformer.get_decorator
_call_builtin: Any = ASTTransformer.build_call_if_is_builtin
_build: Any = ast_transformer.build_stmt
_build_all: Any = ast_transformer.build_stmts
_init: Any = Expr.__init__
_declare: Any = impl.expr_init
_at: Any = impl.subscript
