"""Matrices as DMIG bulk data: read from punch files and decks, and written.

    DMIG    KAAX           0       6       2       0
    DMIG*   KAAX                           3               1     column: point 3, component 1
    *                      3               1 1.250000000D+03     row, and its number
    *                      4               2-3.000000000D+02

Of symmetric matrices (form 6) the file has one triangle, or both. Rows have names, so matrices of
unlike sizes belong together: each is arranged by the names of all. Component 0 of a scalar point is
component x here. EXTSEOUT punches such files; what else is in one stays as it is.
"""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse

from modetune.adapters.deck_files import read_text
from modetune.adapters.nastran.fields import format_number
from modetune.core.errors import ModelError
from modetune.core.modes import Floats, Integers, dof_name
from modetune.core.near_names import suggestion
from modetune.core.storage.files import make_folder

#: Names of files that have DMIG cards among others.
BULK = (".bdf", ".dat", ".nas", ".dmig", ".pch", ".asm")
#: Forms of square matrices, by their headers: square, and symmetric.
SQUARE, SYMMETRIC = 1, 6
#: Lines of a card's own name, those that continue a card, and comments.
CARD = re.compile(r"DMIG\*?[\s,]+([A-Z]\w{0,7})", re.IGNORECASE)
CONTINUED = re.compile(r"[\s+*,]|$")

#: An unknown by node and component, and as DMIG cards name it (component 0 of scalar points).
Dof = tuple[int, int]


@dataclass(frozen=True, slots=True)
class Terms:
    """Terms of a DMIG: rows and columns (n, 2) as node and component, and values (n,)."""

    form: int
    rows: Integers
    columns: Integers
    values: Floats


def read_dmig(path: Path) -> dict[str, Terms | None]:
    """Return the DMIG of a file by name; None for those that are not square or not real.

    Raises ModelError.
    """
    from pyNastran.bdf.bdf import BDF  # takes a moment, and most models have none

    from modetune.adapters.nastran.bulk import OBJECTIONS

    bulk = BDF(debug=None)
    bulk.log.level = "critical"
    text = "\n".join(line for name, line in _by_matrix(read_text(path)) if name)
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # it prints the cards that it refuses
            bulk.read_bdf(io.StringIO(text + "\n"), punch=True, xref=False, validate=False)
    except (*OBJECTIONS, NotImplementedError) as error:
        first = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise ModelError(f"{path}: pyNastran does not read its DMIG cards: {first}") from error
    return {name.upper(): _terms(card) for name, card in bulk.dmig.items()}


def _terms(card: Any) -> Terms | None:
    if getattr(card, "matrix_form", 0) not in (SQUARE, SYMMETRIC) or card.tin not in (1, 2):
        return None
    rows, columns = (np.array(ends, dtype=np.int64).reshape(-1, 2) for ends in (card.GCi, card.GCj))
    return Terms(card.matrix_form, rows, columns, np.array(card.Real, dtype=np.float64))


def one_of(found: Mapping[str, Terms | None], path: Path, name: str) -> Terms:
    """Return a matrix by its name; the only one where the name is empty. Raises ModelError."""
    name = name.upper() or (next(iter(found)) if len(found) == 1 else "")
    if name not in found:
        there = ", ".join(found) or "none"
        raise ModelError(
            f"{path} has the DMIG {there}{suggestion(name, found)}; name one as {path.name}:NAME"
        )
    if (terms := found[name]) is None:
        raise ModelError(f"{path}: DMIG {name} is not real and square (IFO 1 or 6, TIN 1 or 2)")
    return terms


def united(matrices: Iterable[Terms]) -> Integers:
    """Return the unknowns of all matrices (n, 2), ascending."""
    ends = [end for terms in matrices for end in (terms.rows, terms.columns)]
    return np.unique(_in_space(np.concatenate(ends)), axis=0)


def arranged(terms: Terms, names: Integers) -> sparse.csr_array:
    """Return a matrix on unknowns (n, 2) of these names, both triangles. Raises ModelError."""
    places = {name: place for place, name in enumerate(map(tuple, names.tolist()))}
    ends = [list(map(tuple, _in_space(end).tolist())) for end in (terms.rows, terms.columns)]
    if missing := sorted({*ends[0], *ends[1]} - places.keys()):
        raise ModelError(f"`dofs` lacks {dof_name(missing[0])}, of which the DMIG has terms")
    rows, columns = (np.array([places[name] for name in end], dtype=np.int64) for end in ends)
    values, shape = terms.values, (len(names),) * 2
    if terms.form == SQUARE:
        return sparse.csr_array((values, (rows, columns)), shape=shape)
    # Where both mirror images of a term are given they count once.
    pairs = np.maximum(rows, columns) * len(names) + np.minimum(rows, columns)
    pairs, first = np.unique(pairs, return_index=True)
    lower = sparse.csr_array((values[first], np.divmod(pairs, len(names))), shape=shape)
    return sparse.csr_array(lower + sparse.tril(lower, -1).T)


def _in_space(names: Integers) -> Integers:
    """Return nodes and components, x of a scalar point for 0."""
    return np.column_stack([names[:, 0], np.maximum(names[:, 1], 1)])


def dmig_lines(name: str, matrix: Any, names: Sequence[Dof]) -> Iterator[str]:
    """Yield a symmetric matrix (n, n) as a header and the columns of its lower triangle.

    names: of its unknowns, scalar points with component 0. Of symmetric matrices either half is
    given; an entry and its mirror image would be an error.
    """
    yield f"DMIG    {name:8s}{0:8d}{SYMMETRIC:8d}{2:8d}{0:8d}"
    lower = sparse.csc_array(sparse.tril(matrix))
    lower.sort_indices()
    for column, (node, component) in enumerate(names):
        span = slice(*lower.indptr[column : column + 2])
        terms = list(zip(lower.indices[span].tolist(), lower.data[span].tolist(), strict=True))
        if any(value for _, value in terms):
            yield f"{'DMIG*':8s}{name:16s}{node:16d}{component:16d}"
        for row, value in terms:
            if value:
                end = names[row]
                yield f"{'*':8s}{end[0]:16d}{end[1]:16d}{format_number(value, 16):>16s}"


def rewrite_dmig(
    source: Path, target: Path, matrices: Mapping[str, sparse.csr_array], names: Integers
) -> None:
    """Write a file with new matrices (n, n) in place of those of these names (upper case).

    names: of the unknowns (n, 2). A blank name is that of the file's only matrix. What else the
    file has stays. Raises ModelError, OSError.
    """
    text, there, scalars = read_text(source), read_dmig(source), set[int]()
    for terms in there.values():
        if terms is not None:
            ends = np.concatenate([terms.rows, terms.columns])
            scalars.update(ends[ends[:, 1] == 0, 0].tolist())
    dofs = [(node, 0 if node in scalars else component) for node, component in names.tolist()]
    lines = list[str]()
    new = {name or next(iter(there)): matrix for name, matrix in matrices.items()}
    left = dict(new)
    for name, line in _by_matrix(text):
        if name not in new:
            lines.append(line)
        elif name in left:
            lines += dmig_lines(name, left.pop(name), dofs)
    make_folder(target.parent)
    target.write_bytes(("\n".join(lines) + "\n").encode("utf-8", "surrogateescape"))


def _by_matrix(text: str) -> Iterator[tuple[str, str]]:
    """Yield each line of a text behind the name of the DMIG that it belongs to, or nothing."""
    name = ""
    for line in text.splitlines():
        if found := CARD.match(line):
            name = found[1].upper()
        elif not CONTINUED.match(line) and not line.startswith("$"):
            name = ""
        yield ("" if line.startswith("$") else name), line
