"""Fewer statements than Taichi makes, to the same bits: its own have branches and functions in them that nobody needs.

Everything here knows the inside of Taichi 1.7.4; with another one, statements are those that Taichi makes.
"""

import ast
import operator
from functools import wraps
from typing import Any

import numpy as np
from taichi._lib import core
from taichi.lang import impl, matrix_ops, ops
from taichi.lang.ast import ast_transformer
from taichi.lang.ast.ast_transformer import ASTTransformer
from taichi.lang.expr import Expr

from ..language import active, at, ti

COMPARISONS = {
    ast.Eq: operator.eq, ast.NotEq: operator.ne, ast.Lt: operator.lt, ast.LtE: operator.le, ast.Gt: operator.gt,
    ast.GtE: operator.ge,
}  # fmt: skip


def _compared(ctx: Any, node: Any) -> Any:
    """A comparison of two. Taichi makes `True and a < b` of it, which is a branch, and then a truth value of what is one."""
    compare = COMPARISONS.get(type(node.ops[0]))
    if not active or compare is None or len(node.ops) > 1:
        return _compare(ctx, node)
    ast_transformer.build_stmt(ctx, node.left)
    ast_transformer.build_stmt(ctx, node.comparators[0])
    node.ptr = compare(node.left.ptr, node.comparators[0].ptr)
    if node.ptr.is_tensor() if type(node.ptr) is Expr else not isinstance(node.ptr, (bool, np.bool_)):
        node.ptr = ti.cast(node.ptr, ti.u1)
    return node.ptr


def _selected(cond: Any, x1: Any, x2: Any) -> Any:
    """One of two. Taichi makes a truth value of the condition, by denying it twice, also where it is one."""
    if not active or type(cond) is not Expr or cond.is_tensor() or cond.ptr.get_rvalue_type() != ti.u1:
        return _select(cond, x1, x2)
    return ops._ternary_operation(core.expr_select, None, cond, x1, x2)


def _product(x: Any, y: Any) -> Any:
    """The dot product of two vectors: the same sum in the same order, without the functions inside functions that Taichi makes
    of it, which copy their arguments."""
    vectors = isinstance(x, Expr) and isinstance(y, Expr) and x.is_tensor() and x.get_shape() == y.get_shape()
    if not active or not impl.inside_kernel() or not vectors or len(x.get_shape()) > 1:
        return _dot(x, y)
    parts = impl.expr_init(x * y)
    return sum((at(parts, k) for k in range(1, x.get_shape()[0])), at(parts, 0))


def apply() -> None:
    """Put these in the place of what Taichi calls."""
    ASTTransformer.build_Compare = staticmethod(_compared)
    ti.select = ops.select = wraps(_select)(_selected)
    matrix_ops.dot = wraps(_dot)(_product)


_compare: Any = ASTTransformer.build_Compare
_select: Any = ops.select
_dot: Any = matrix_ops.dot
