"""Columns computed from others."""

from __future__ import annotations

import ast
import operator
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from sil.campaign.binary_tables import Floats


def formula(text: str, columns: Mapping[str, Floats]) -> Floats:
    """Return a column [n] computed from others: numbers, + - * / **, names; quoted if not plain.

    `row` counts the rows from 0. Raises KeyError for an unknown name, ValueError for no formula.
    """
    count = len(next(iter(columns.values())))
    operations: dict[type[ast.AST], Callable[..., Any]] = {
        ast.Add: operator.add,
        ast.Sub: operator.sub,
        ast.Mult: operator.mul,
        ast.Div: operator.truediv,
        ast.Pow: operator.pow,
        ast.USub: operator.neg,
        ast.UAdd: operator.pos,
    }

    def value(node: ast.AST) -> Any:
        match node:
            case ast.Expression():
                return value(node.body)
            case ast.BinOp():
                return operations[type(node.op)](value(node.left), value(node.right))
            case ast.UnaryOp():
                return operations[type(node.op)](value(node.operand))
            case ast.Constant(value=int() | float() as number):
                return float(number)
            case ast.Constant(value=str() as name) | ast.Name(id=name):
                return np.arange(count, dtype=np.float64) if name == "row" else columns[name]
        raise ValueError(text)

    try:
        tree = ast.parse(text, mode="eval")
        with np.errstate(all="ignore"):
            result = np.asarray(value(tree), dtype=np.float64)
    except (SyntaxError, TypeError, ArithmeticError) as error:
        raise ValueError(text) from error
    return np.array(np.broadcast_to(result, count))
