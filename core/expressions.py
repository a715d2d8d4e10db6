"""Relations between parameters: arithmetic on their values, written as in any program.

Names, numbers, `pi`, the operators + - * / ** and the functions below; nothing else is read, so an
expression can do nothing but compute. It is read by Python's own grammar.
"""

from __future__ import annotations

import ast
import math
from collections.abc import Callable, Iterator, Mapping
from functools import cache

from modetune.core.errors import ModelError

FUNCTIONS: dict[str, Callable[..., float]] = {
    "sqrt": math.sqrt, "exp": math.exp, "log": math.log, "log10": math.log10, "sin": math.sin,
    "cos": math.cos, "tan": math.tan, "asin": math.asin, "acos": math.acos, "atan": math.atan,
    "sinh": math.sinh, "cosh": math.cosh, "tanh": math.tanh, "abs": abs, "min": min, "max": max,
}  # fmt: skip
#: Functions of two arguments or more; the others take one.
OF_SEVERAL = ("min", "max")
OPERATORS: dict[type[ast.operator], Callable[[float, float], float]] = {
    ast.Add: lambda a, b: a + b,
    ast.Sub: lambda a, b: a - b,
    ast.Mult: lambda a, b: a * b,
    ast.Div: lambda a, b: a / b,
    ast.Pow: lambda a, b: math.pow(a, b),
}
#: A number of more digits is no number of an engineer, and may be none of a computer's.
MOST = 1e300
#: Levels of brackets: more are a slip of a program that wrote them.
DEEPEST = 50


def names_of(expression: str) -> tuple[str, ...]:
    """The parameters that an expression names, each once. Raises ModelError."""
    found = (node.id for node in ast.walk(read(expression)) if isinstance(node, ast.Name))
    return tuple(dict.fromkeys(name for name in found if name != "pi" and name not in FUNCTIONS))


def evaluate(expression: str, values: Mapping[str, float]) -> float:
    """Its value. Raises ModelError where it has none: division by zero, a root of less than 0."""
    try:
        found = _value(read(expression), values)
    except ZeroDivisionError:
        found = math.inf
    except (ValueError, OverflowError):
        found = math.nan
    if not math.isfinite(found):
        at = ", ".join(f"{name} = {values[name]:.6g}" for name in names_of(expression))
        why = "divides by zero" if found == math.inf else "has no finite value"
        raise ModelError(f"the expression {expression} {why} at {at or 'all values'}")
    return found


def degree(expression: str) -> int:
    """0 for a constant, 1 where it is a sum of parameters with constant factors, else 2."""
    return _degree(read(expression))


@cache
def read(expression: str) -> ast.expr:
    """The expression's parts. Raises ModelError naming the first that is not arithmetic."""
    try:
        tree = ast.parse(expression.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        raise ModelError(f"the expression {expression[:80]!r} is not arithmetic") from None
    _check(tree, expression, 0)
    return tree


def _check(node: ast.expr, expression: str, depth: int) -> None:
    good = depth <= DEEPEST
    match node:
        case ast.BinOp(op=op):
            good = good and type(op) in OPERATORS
        case ast.UnaryOp(op=ast.USub() | ast.UAdd()) | ast.Name():
            pass
        case ast.Constant(value=int() | float() as value):
            good = good and not isinstance(value, bool) and abs(value) < MOST
        case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]):
            several = name in OF_SEVERAL
            count = len(arguments)
            good = good and name in FUNCTIONS and (count > 1 if several else count == 1)
        case _:
            good = False
    if not good:
        raise ModelError(
            f"the expression {expression[:80]!r} holds {ast.unparse(node)[:40]!r}, which is not "
            f"arithmetic; there are + - * / **, numbers, pi and {', '.join(FUNCTIONS)}"
        )
    for part in parts(node):
        _check(part, expression, depth + 1)


def parts(node: ast.expr) -> Iterator[ast.expr]:
    """The operands or arguments of a part."""
    match node:
        case ast.BinOp(left=left, right=right):
            yield from (left, right)
        case ast.UnaryOp(operand=operand):
            yield operand
        case ast.Call(args=arguments):
            yield from arguments


def _value(node: ast.expr, values: Mapping[str, float]) -> float:
    given = [_value(part, values) for part in parts(node)]
    match node:
        case ast.BinOp(op=op):
            return OPERATORS[type(op)](*given)
        case ast.UnaryOp(op=op):
            return -given[0] if isinstance(op, ast.USub) else given[0]
        case ast.Call(func=ast.Name(id=name)):
            return float(FUNCTIONS[name](*given))
        case ast.Name(id=name):
            return math.pi if name == "pi" else float(values[name])
        case ast.Constant(value=int() | float() as value):
            return float(value)
    raise AssertionError(ast.dump(node))


def _degree(node: ast.expr) -> int:
    degrees = [_degree(part) for part in parts(node)]
    match node:
        case ast.Name(id=name):
            return 0 if name == "pi" else 1
        case ast.BinOp(op=ast.Add() | ast.Sub()):
            return max(degrees)
        case ast.BinOp(op=ast.Mult()):
            return min(sum(degrees), 2)
        case ast.BinOp(op=ast.Div()):
            return degrees[0] if degrees[1] == 0 else 2
        case ast.UnaryOp():
            return degrees[0]
    return 2 if any(degrees) else 0
