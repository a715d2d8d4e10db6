"""Expressions of parameters as DEQATN cards.

Nastran's equations are Fortran's: upper case, real numbers with a point, lines of 56 columns behind
the number and of 64 columns after it.
"""

from __future__ import annotations

import ast
import math
import re
from collections.abc import Mapping

from modetune.core.expressions import parts, read

OPERATORS: dict[type[ast.operator], str] = {
    ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.Pow: "**",
}  # fmt: skip
#: Columns of the equation in its first line, and in the others.
FIRST, REST = 56, 64
#: What a line is not broken within: a number, a name, a power, or one other character.
TOKEN = re.compile(r"\d+\.\d*(?:E[+-]?\d+)?|\w+|\*\*|.")


def in_fortran(expression: str, names: Mapping[str, str]) -> str:
    """An expression in Nastran's words; names: what stands for each parameter."""
    return _text(read(expression), names)


def real(value: float) -> str:
    """A number that Nastran takes for a real one."""
    text = repr(float(value)).upper()
    if "." not in text:
        text = text.replace("E", ".0E") if "E" in text else f"{text}.0"
    return f"({text})" if value < 0.0 else text


def equation_card(number: int, arguments: list[str], text: str) -> list[str]:
    """A DEQATN card."""
    rows = [""]
    for token in TOKEN.findall(f"F({','.join(arguments)})={text}"):
        if len(rows[-1]) + len(token) > (FIRST if len(rows) == 1 else REST):
            rows.append("")
        rows[-1] += token
    heads = [f"{'DEQATN':<8}{number:<8}", *[" " * 8] * (len(rows) - 1)]
    return [f"{head}{row}" for head, row in zip(heads, rows, strict=True)]


def _text(node: ast.expr, names: Mapping[str, str]) -> str:
    given = [_text(part, names) for part in parts(node)]
    match node:
        case ast.BinOp(op=op):
            return f"({given[0]}{OPERATORS[type(op)]}{given[1]})"
        case ast.UnaryOp(op=op):
            return f"(-{given[0]})" if isinstance(op, ast.USub) else given[0]
        case ast.Call(func=ast.Name(id=name)):
            return f"{name.upper()}({','.join(given)})"
        case ast.Name(id=name):
            return real(math.pi) if name == "pi" else names[name]
        case ast.Constant(value=int() | float() as value):
            return real(float(value))
    raise AssertionError(ast.dump(node))
