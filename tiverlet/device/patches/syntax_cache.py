"""How Taichi's Python translates the trees of tiverlet's functions: the same statements in three quarters of the time.

At each node Taichi computes again what it has computed before: the node's position, its own settings, which of a dozen kinds of
values a node has. Here this is computed once, or the few kinds that tiverlet's kernels use are tested first. All others take
Taichi's own path, and so do kernels that the user compiles in the same process.
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

PLACES = 1000  # source positions kept as the DebugInfo that Taichi passes to its compiler
INT = range(-(2**31), 2**31)  # values of an integer literal of the default type
BUILTINS = {id(f) for f in (print, min, max, int, bool, float, any, all, abs, pow, len, operator.matmul)}  # replaced by Taichi


def _decorated(ctx: Any, node: Any) -> str:
    """Return which of Taichi's decorators a call is. Taichi searches for it at every call, and at every turn of a static loop."""
    if not active:
        return _decorator(ctx, node)
    if not hasattr(node, "decorator"):
        node.decorator = _decorator(ctx, node)
    return node.decorator


@cache
def _method(kind: type) -> Any:
    return getattr(ASTTransformer, f"build_{kind.__name__}", None)


class _Failed:
    """Takes the place of Taichi's translator and raises an error that has occurred already."""

    def __init__(self, error: Exception):
        self._error = error

    def __getattr__(self, name: str) -> Any:
        def fail(ctx, node):
            """Raise the error of the translation."""
            raise self._error

        return fail


def _visited(self: Any, ctx: Any, node: Any) -> Any:
    """Translate a node. Taichi formats the position of each again, which takes as long as the rest of its Python."""
    kind = type(node)
    method = _method(kind)
    if not active or method is None:
        return _visit(self, ctx, node)
    if kind is ast.Name:  # every third node; looking up a local name cannot fail, so it needs no position
        for names in reversed(ctx.local_scopes):
            if node.id in names:
                node.ptr = names[node.id]
                return node.ptr
    if kind is ast.Attribute:
        node.__dict__.pop("caller", None)  # left from the last translation of the tree
    places = impl.pytaichi.src_info_stack
    places.append(ctx.get_pos_info(node) if hasattr(node, "lineno") else ctx.place)
    try:
        return method(ctx, node)
    except Exception as e:
        return _visit(_Failed(e), ctx, node)  # Taichi adds the position to the error
    finally:
        places.pop()


def _statements(ctx: Any, nodes: Any) -> Any:
    """Translate nodes one after the other, up to a `return`, or a `break` or `continue` of a static loop."""
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
    """Whether a call is of a Python builtin, and translate it; Taichi makes a dictionary of the builtins for every call."""
    return id(node.func.ptr) in BUILTINS and _call_builtin(ctx, node, args, keywords)


def _express(self: Any, *args: Any, dbg_info: Any = None, dtype: Any = None) -> None:
    """Initialise an expression from one of the compiler's, from another Expr or from a number."""
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
    """Declare a variable with a value. Most values are single expressions, which Taichi tests for last."""
    if not active or type(value) is not Expr:
        return _declare(value)
    runtime: Any = impl.pytaichi
    builder = runtime.compiling_callable.ast_builder()
    return Expr(builder.expr_var(value.ptr, core.DebugInfo(runtime.src_info_stack[-1])))


def _subscript(builder: Any, value: Any, *indices: Any, **options: Any) -> Any:
    """Translate value[indices], by a short path if all indices are expressions and numbers."""
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
    """Return the compiler's object for a field, an array or a vector; None for any other value."""
    kind = type(value)
    if kind is ScalarField:
        return value.vars[0].ptr
    return value.ptr if kind in (MatrixField, AnyArray) or kind is Expr and value.is_tensor() else None


def apply() -> None:
    """Replace Taichi's functions by these."""
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
