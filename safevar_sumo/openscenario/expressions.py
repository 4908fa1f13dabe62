"""Values: literals, `$parameters`, `${expressions}`, and rules that compare them (classes
Expression, Rule).
"""

from __future__ import annotations

import ast
import math
import operator
import re
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from safevar_sumo.errors import InputError

Values = Mapping[str, str]
FUNCTIONS: Mapping[str, Callable[..., float]] = {
    "round": lambda x: math.floor(x + 0.5),
    "sign": lambda x: (x > 0) - (x < 0),
    "abs": abs,
    "max": max,
    "min": min,
    **{
        name: getattr(math, name)
        for name in ("floor", "ceil", "sqrt", "pow", "sin", "cos", "tan", "asin", "acos", "atan")
    },
}
CONSTANTS: Mapping[str, float] = {"pi": math.pi, "e": math.e, "true": True, "false": False}
OPERATORS: Mapping[type, Callable[..., Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Mod: math.fmod,
    ast.USub: operator.neg,
    ast.UAdd: operator.pos,
    ast.Not: operator.not_,
    ast.Lt: operator.lt,
    ast.Gt: operator.gt,
    ast.LtE: operator.le,
    ast.GtE: operator.ge,
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
}
RULES: Mapping[str, Callable[[Any, Any], Any]] = {
    "equalTo": operator.eq,
    "notEqualTo": operator.ne,
    "greaterThan": operator.gt,
    "lessThan": operator.lt,
    "greaterOrEqual": operator.ge,
    "lessOrEqual": operator.le,
}
"""The rules of class Rule."""
NAME = re.compile(r"\$\{?([A-Za-z_]\w*)\}?")
MAX_LENGTH = 1000
"""Longest expression [characters]."""


def literal(text: str, values: Values) -> str:
    """An attribute's value with its parameters and expressions replaced."""
    text = text.strip()
    if text.startswith("${") and text.endswith("}"):
        found = evaluate(text[2:-1], values)
        return str(found).lower() if isinstance(found, bool) else repr(found)
    if text.startswith("${"):
        raise InputError("", f"the expression {text} is not closed", "a brace } at its end")
    if text.startswith("$"):
        return _value(text[1:], values)
    return text


def text_of(value: Any) -> str:
    """A value as a file has it."""
    if isinstance(value, str):
        return value
    if isinstance(value, bool | np.bool_):
        return str(bool(value)).lower()
    return repr(int(value) if float(value).is_integer() else float(value))


def compare(rule: str, value: str, limit: str) -> bool:
    """Whether two texts satisfy a rule, as numbers if both are numbers."""
    try:
        return bool(RULES[rule](float(value), float(limit)))
    except ValueError:
        return bool(RULES[rule](value, limit))


def _value(name: str, values: Values) -> str:
    if name not in values:
        raise InputError("", f"the file declares no parameter {name}", "a declared one")
    return values[name]


def evaluate(expression: str, values: Values) -> Any:
    """The value of the inside of `${...}`."""
    try:
        if len(expression) > MAX_LENGTH:
            raise ValueError("it is too long")
        text = NAME.sub(lambda match: f"({_value(match[1], values)})", expression)
        return _evaluated(ast.parse(text.strip(), mode="eval").body)
    except (SyntaxError, ValueError, ArithmeticError, TypeError, KeyError, RecursionError) as error:
        raise InputError(
            "",
            f"the expression ${{{expression}}} has no value: {error}",
            "an expression of declared parameters and numbers",
        ) from None


def _evaluated(node: ast.expr) -> Any:
    match node:
        case ast.Constant(value=int() | float() as found):
            return found
        case ast.BinOp(left=left, op=operation, right=right):
            return OPERATORS[type(operation)](_evaluated(left), _evaluated(right))
        case ast.UnaryOp(op=operation, operand=operand):
            return OPERATORS[type(operation)](_evaluated(operand))
        case ast.BoolOp(op=ast.And(), values=operands):
            return all(map(_evaluated, operands))
        case ast.BoolOp(op=ast.Or(), values=operands):
            return any(map(_evaluated, operands))
        case ast.Compare(left=left, ops=[operation], comparators=[right]):
            return OPERATORS[type(operation)](_evaluated(left), _evaluated(right))
        case ast.Name(id=name):
            return CONSTANTS[name]
        case ast.Call(func=ast.Name(id=name), args=arguments):
            return FUNCTIONS[name](*map(_evaluated, arguments))
    raise ValueError(f"{type(node).__name__} is not supported")
