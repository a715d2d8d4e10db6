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
#: First and second derivatives of the functions of one argument.
SLOPES: dict[str, Callable[[float], tuple[float, float]]] = {
    "sqrt": lambda x: (0.5 / math.sqrt(x), -0.25 / (x * math.sqrt(x))),
    "exp": lambda x: (math.exp(x), math.exp(x)),
    "log": lambda x: (1.0 / x, -1.0 / x**2),
    "log10": lambda x: (1.0 / (x * math.log(10.0)), -1.0 / (x**2 * math.log(10.0))),
    "sin": lambda x: (math.cos(x), -math.sin(x)),
    "cos": lambda x: (-math.sin(x), -math.cos(x)),
    "tan": lambda x: (1.0 + math.tan(x) ** 2, 2.0 * math.tan(x) * (1.0 + math.tan(x) ** 2)),
    "asin": lambda x: ((1.0 - x * x) ** -0.5, x * (1.0 - x * x) ** -1.5),
    "acos": lambda x: (-((1.0 - x * x) ** -0.5), -x * (1.0 - x * x) ** -1.5),
    "atan": lambda x: (1.0 / (1.0 + x * x), -2.0 * x / (1.0 + x * x) ** 2),
    "sinh": lambda x: (math.cosh(x), math.sinh(x)),
    "cosh": lambda x: (math.sinh(x), math.cosh(x)),
    "tanh": lambda x: (1.0 - math.tanh(x) ** 2, -2.0 * math.tanh(x) * (1.0 - math.tanh(x) ** 2)),
    "abs": lambda x: (math.copysign(1.0, x), 0.0),
}
#: A value with its first and second derivatives.
Jet = tuple[float, float, float]
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


def slopes(expression: str, values: Mapping[str, float], name: str) -> tuple[float, float]:
    """Return the exact first and second derivatives with respect to a name.

    Where min, max or abs has a kink they are those of one side. Raises ModelError where there are
    none, as of a root of 0.
    """
    try:
        _, first, second = _jet(read(expression), values, name)
    except (ZeroDivisionError, ValueError, OverflowError):
        first = second = math.nan
    if not (math.isfinite(first) and math.isfinite(second)):
        at = ", ".join(f"{item} = {values[item]:.6g}" for item in names_of(expression))
        raise ModelError(f"the expression {expression} has no derivative in {name} at {at}")
    return first, second


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
    if depth > DEEPEST:  # `ast` cannot write it either
        raise ModelError(
            f"the expression {expression[:80]!r} has more than {DEEPEST} operations one in another"
        )
    good = True
    match node:
        case ast.BinOp(op=op):
            good = type(op) in OPERATORS
        case ast.UnaryOp(op=ast.USub() | ast.UAdd()) | ast.Name():
            pass
        case ast.Constant(value=int() | float() as value):
            good = not isinstance(value, bool) and abs(value) < MOST
        case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]):
            several = name in OF_SEVERAL
            count = len(arguments)
            good = name in FUNCTIONS and (count > 1 if several else count == 1)
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


def _jet(node: ast.expr, values: Mapping[str, float], name: str) -> Jet:
    given = [_jet(part, values, name) for part in parts(node)]
    match node:
        case ast.BinOp(op=op):
            return _combined(op, *given)
        case ast.UnaryOp(op=op):
            sign = -1.0 if isinstance(op, ast.USub) else 1.0
            value, first, second = given[0]
            return sign * value, sign * first, sign * second
        case ast.Call(func=ast.Name(id=function)) if function in OF_SEVERAL:
            return (min if function == "min" else max)(given, key=lambda jet: jet[0])
        case ast.Call(func=ast.Name(id=function)):
            value, first, second = given[0]
            slope, curvature = SLOPES[function](value) if first or second else (0.0, 0.0)
            there = FUNCTIONS[function](value)
            return there, slope * first, curvature * first**2 + slope * second
    return _value(node, values), float(isinstance(node, ast.Name) and node.id == name), 0.0


def _combined(op: ast.operator, left: Jet, right: Jet) -> Jet:
    """Return a sum, product, quotient or power."""
    (a, a1, a2), (b, b1, b2) = left, right
    value = OPERATORS[type(op)](a, b)
    match op:
        case ast.Add():
            return value, a1 + b1, a2 + b2
        case ast.Sub():
            return value, a1 - b1, a2 - b2
        case ast.Mult():
            return value, a1 * b + a * b1, a2 * b + 2.0 * a1 * b1 + a * b2
        case ast.Div():
            first = (a1 - value * b1) / b
            return value, first, (a2 - 2.0 * first * b1 - value * b2) / b
    if not (b1 or b2):  # a constant power, also of a negative number
        slope, curvature = (
            factor * math.pow(a, b - order) if factor else 0.0
            for order, factor in ((1, b), (2, b * (b - 1.0)))
        )
        return value, slope * a1, curvature * a1**2 + slope * a2
    log, ratio = math.log(a), a1 / a
    rate = b1 * log + b * ratio
    turn = b2 * log + 2.0 * b1 * ratio + b * (a2 / a - ratio**2)
    return value, value * rate, value * (rate**2 + turn)


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
