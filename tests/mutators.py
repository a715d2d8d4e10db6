"""Mutators: each makes wrong files of a good one, by a seeded generator.

`spoil_bytes` knows nothing of a file: it flips bits, overwrites, cuts, repeats or swaps pieces,
changes a number, or puts words in that readers stumble over. The others know its structure:

- `of_text`: blocks of lines (cards, keywords, datasets, rows, pages) are repeated, reordered,
  grown, merged, given to a file that is included (nested, cyclic, missing); fields are swapped,
  emptied, renamed everywhere, grown; line ends and encoding change;
- `of_yaml`: values become other values, keys move, keys of a schema come in, lists and depth grow;
- `of_records`: the records of Fortran's unformatted files (OP2, OP4);
- `of_workbook`, `of_archive`, `of_mat`, `of_hdf5`: cells, members, variables, datasets.
"""

from __future__ import annotations

import datetime
import io
import re
import struct
import tempfile
import warnings
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import yaml
from openpyxl import Workbook, load_workbook
from scipy.io import loadmat, savemat

Random = np.random.Generator
#: Files by name; the reader is given MAIN, the others are what it may include.
Files = dict[str, bytes]
Mutator = Callable[[bytes, Random], Files]
MAIN = "input"
#: No mutation grows a text beyond this, bytes; what is read in seconds is not what is looked for.
MOST_TEXT = 400_000
#: What readers stumble over.
WORDS = (
    b"nan", b"inf", b"-1", b"0", b"1e999", b"99999999999999999999", b"\0", b"\xff\xfe", b"\n",
    b"\r", b",", b",,,,", b":", b"[", b"{", b"}", b"- ", b"&a", b"*a", b"!!x", b"'", b'"', b"#",
    b"$", b"*", b"**", b"=", b"\t", b" ", b"+", b"1.0-101", b"THRU", b"true", b"null", b"~", b"../",
    "½".encode(), "٣".encode(), b"\xc2\x85", b"\xe2\x80\xa8", b"1_000", b"0x10", b".",
)  # fmt: skip
#: What numbers are changed to.
NUMBERS = (
    b"0", b"-1", b"1", b"2", b"7", b"99999999", b"1000000000", b"2147483648", b"4294967296",
    b"9223372036854775808", b"1" + 30 * b"0", b"1e308", b"1e-320",
)  # fmt: skip
#: What values of YAML, cells and variables are changed to.
VALUES: tuple[Any, ...] = (
    None, True, 0, -1, 1, 7, 2**31, 2**63, 10**40, 0.0, 1e-320, 1e308, float("nan"), float("inf"),
    "", " ", "x", "none", "1.5", "1,5", "../..", "input", "a\nb", "7" * 5000, "é½٣", [], {}, [[]],
    [1, "a"], {"a": 1}, {"x": {"y": {"z": []}}}, datetime.date(2020, 2, 29),
)  # fmt: skip
FIELD = re.compile(rb"[^,;\t\s=/()'\"]+")
LINE_ENDS = (b"\r", b"\r\n", b"\n\n", b"\x0c\n", b"\n\r", b" \n", b"\xe2\x80\xa8", b"\x0b")
ENCODINGS = ("utf-16", "utf-16-le", "utf-8-sig", "utf-32", "utf-32-be", "cp037", "utf-7")


def below(random: Random, most: int) -> int:
    """A number from 0 to most - 1."""
    return int(random.integers(0, most))


def one_of(random: Random, items: Sequence[Any]) -> Any:
    """One of some items."""
    return items[below(random, len(items))]


def span(random: Random, count: int, most: int) -> slice:
    """A place among `count` items and up to `most` items behind it."""
    first = below(random, count)
    return slice(first, first + 1 + below(random, most))


def spoil_bytes(good: bytes, random: Random) -> Files:
    """A good file with one to four things done to its bytes."""
    data = bytearray(good)
    for _ in range(1 + below(random, 4)):
        place, other = below(random, len(data) + 1), below(random, len(data) + 1)
        length = 1 + below(random, 39)
        match below(random, 9):
            case 0:
                data[place : place + 1] = bytes([below(random, 256)])
            case 1 if place < len(data):
                data[place] ^= 1 << below(random, 8)
            case 2:
                del data[place : place + length]
            case 3:
                data[place:place] = data[other : other + length]
            case 4 | 5:
                data[place:place] = one_of(random, WORDS)
            case 6:
                numbers = list(re.finditer(rb"\d+", data))
                if numbers:
                    number = one_of(random, numbers)
                    data[number.start() : number.end()] = one_of(random, NUMBERS)
            case _ if random.random() < 0.2:
                del data[place:]
            case _:
                data[place : place + length] = data[other : other + length]
    return {MAIN: bytes(data)}


@dataclass(frozen=True)
class Language:
    """What the lines of a text mean.

    head: the first line of a block. includes: lines that bring in another file, `{}` for its name.
    """

    head: re.Pattern[bytes] = re.compile(rb"")
    includes: tuple[str, ...] = ()


KEYWORDS = Language(
    re.compile(rb"\*[A-Za-z]"),
    ("*INCLUDE, INPUT={}", '*include,input="{}"', "*Include,\ninput={}"),
)
CARDS = Language(
    re.compile(rb"[A-Za-z$]"), ("INCLUDE '{}'", 'include "{}"', "INCLUDE {}", "INCLUDE '\n{}'")
)
DATASETS = Language(re.compile(rb" {4}-1\s*$"))
ROWS = Language()
#: Print files, and results in fixed columns.
PAGES = Language(re.compile(rb"1? *$|1 {3}|\$EIG|.*[A-Z] [A-Z] [A-Z]| {4}[123]C| +1PSTEP"))


def of_text(language: Language) -> Mutator:
    """Mutations of a text in this language, one to three at a time."""

    def mutate(good: bytes, random: Random) -> Files:
        files = {MAIN: good}
        for _ in range(1 + below(random, 3)):
            kind = random.random()
            if kind < 0.35:
                files[MAIN] = _other_blocks(files[MAIN], language, random)
            elif kind < 0.7:
                files[MAIN] = _other_fields(files[MAIN], random)
            elif kind < 0.85 and language.includes:
                files = _other_includes(files, language, random)
            else:
                name = one_of(random, sorted(files))
                files[name] = _other_text(files[name], random)
        return {name: data[: 2 * MOST_TEXT] for name, data in files.items()}

    return mutate


def _other_blocks(data: bytes, language: Language, random: Random) -> bytes:
    """Repeat, reorder, remove, merge, cut or grow blocks of lines."""
    blocks: list[list[bytes]] = [[]]
    for line in data.split(b"\n"):
        if language.head.match(line) and blocks[-1]:
            blocks.append([])
        blocks[-1].append(line)
    one, other = (below(random, len(blocks)) for _ in range(2))
    match below(random, 9):
        case 0:
            blocks[other:other] = [blocks[one]] * one_of(random, (1, 1, 2, 50))
        case 1:
            blocks[one], blocks[other] = blocks[other], blocks[one]
        case 2:
            del blocks[span(random, len(blocks), 5)]
        case 3:  # one goes on as the other, without its head
            blocks[one] = blocks[one] + blocks[other][1:]
        case 4:  # two in one line
            blocks[one] = [one_of(random, (b"", b",", b" ")).join(blocks[one] + blocks[other])]
        case 5:
            blocks[one] = blocks[one][: below(random, len(blocks[one]) + 1)]
        case 6:
            order = random.permutation(len(blocks)).tolist()
            blocks = [blocks[place] for place in order]
        case 7:
            blocks[one] = _grown(blocks[one], random)
        case _:
            moved = blocks.pop(one)
            into = blocks[other % len(blocks)] if blocks else moved
            place = below(random, len(into) + 1)
            into[place:place] = moved
    return b"\n".join(line for block in blocks for line in block)


def _grown(block: list[bytes], random: Random) -> list[bytes]:
    """A block whose last line, or whole, comes many times, half the time with other numbers."""
    part = block if random.random() < 0.5 else block[-1:]
    size = 1 + sum(map(len, part)) + len(part)
    count = min(int(10 ** random.uniform(1.0, 4.0)), MOST_TEXT // 2 // size)
    if random.random() < 0.5:
        return block + part * count
    first = 1 + below(random, 10**5)
    renumbered = [
        re.sub(rb"\d+", b"%d" % (first + number), line, count=1)
        for number in range(count)
        for line in part
    ]
    return block + renumbered


def _other_fields(data: bytes, random: Random) -> bytes:
    """Change fields of a line, or one word wherever it is."""
    lines = data.split(b"\n")
    for _ in range(20):
        place, source = below(random, len(lines)), below(random, len(lines))
        fields, others = list(FIELD.finditer(lines[place])), FIELD.findall(lines[source])
        if fields and others:
            break
    else:
        return data
    field, other, line = one_of(random, fields), one_of(random, others), lines[place]
    match below(random, 9):
        case 0:
            new = b""
        case 1:
            new = other
        case 2:
            new = one_of(random, (b",", b" ", b";")).join(
                [field.group()] * (2 + below(random, 300))
            )
        case 3:
            new = one_of(random, (b"7", b"A", "é".encode(), b"1.")) * one_of(
                random, (9, 20, 300, 400, 5_000, 100_000)
            )
        case 4:
            new = one_of(random, NUMBERS)
        case 5:
            new = one_of(random, WORDS)
        case 6:  # renamed everywhere: names, numbers of nodes, words of the language
            word = rb"(?<![\w.])" + re.escape(field.group()) + rb"(?![\w.])"
            return bytes(re.sub(word, lambda _: other, data)[:MOST_TEXT])
        case 7:
            return data.swapcase() if random.random() < 0.2 else data.replace(line, line.swapcase())
        case _:
            new = field.group().translate(bytes.maketrans(b".eE", b",dD"))
    lines[place] = line[: field.start()] + new + line[field.end() :]
    return b"\n".join(lines)


def _other_includes(files: Files, language: Language, random: Random) -> Files:
    """Move lines to files that are included: one, nested ones, rings, missing ones, folders."""
    lines = files[MAIN].split(b"\n")
    part = span(random, len(lines), len(lines))
    name = f"part{len(files)}.inc"

    def include(target: str) -> bytes:
        line: str = one_of(random, language.includes)
        return line.format(target).encode()

    deep = 2 + below(random, 120)
    match below(random, 7):
        case 0:
            made = {name: b"\n".join(lines[part])}
        case 1:  # a ring
            made = {name: b"\n".join([*lines[part], include(MAIN)])}
        case 2:  # a chain
            chain = [f"{name}{level}" for level in range(deep)]
            made = dict(zip([name, *chain], map(include, chain), strict=False))
            made[chain[-1]] = b"\n".join(lines[part])
        case 3:  # the same lines, again and again
            made = {name: b"\n".join(lines[part])}
            lines[part.stop : part.stop] = [include(name)] * one_of(random, (1, 3, 40))
        case 4:
            return {**files, MAIN: b"\n".join([*lines[: part.start], include("missing.inc")])}
        case 5:
            place = one_of(random, (".", "..", "/", "/dev/null", "", "a" * 5000, "\0", "*", "~"))
            return {**files, MAIN: b"\n".join([*lines[: part.start], include(place)])}
        case _:  # of another coding
            made = {name: _other_text(b"\n".join(lines[part]), random)}
    lines[part] = [include(name)]
    return {**files, **made, MAIN: b"\n".join(lines)}


def _other_text(data: bytes, random: Random) -> bytes:
    """Change line ends, encoding, blanks and length of a text."""
    place = below(random, len(data) + 1)
    match below(random, 8):
        case 0:
            return data.replace(b"\n", one_of(random, LINE_ENDS))
        case 1:  # from a place on
            return data[:place] + data[place:].replace(b"\n", one_of(random, LINE_ENDS))
        case 2 | 3:
            text = data.decode("latin-1").replace("a", one_of(random, ("a", "é", "µ", "λ", "😀")))
            coding: str = one_of(random, (*ENCODINGS, "latin-1", "utf-8"))
            return text.encode(coding, "replace")
        case 4:  # two files in one
            return data + b"\x1a" * below(random, 2) + data.decode("latin-1").encode("utf-16")
        case 5:
            blank: bytes = one_of(random, (b" ", b"\t", b"\n", b"$", b"*", b",", b"\xa0"))
            return (
                data[:place] + blank * int(one_of(random, (1, 80, 10_000, 300_000))) + data[place:]
            )
        case 6:
            blank = one_of(random, (b"\t", b"  ", b"\xc2\xa0", b""))
            return data.replace(b" ", blank)
        case _:
            return data.rstrip(b"\n") if random.random() < 0.5 else data[:place]


def of_yaml(schema: Mapping[str, Any] | None = None) -> Mutator:
    """Mutations of a YAML file; schema: a JSON schema with keys that may come in."""

    def mutate(good: bytes, random: Random) -> Files:
        data = yaml.safe_load(good)
        for _ in range(1 + below(random, 2)):
            if schema and random.random() < 0.4:
                data = _with_key(data, schema, schema, random)
            else:
                data = _other_value(data, random)
        flow = one_of(random, (None, True, False))
        text = yaml.dump(data, default_flow_style=flow, allow_unicode=True, sort_keys=flow is True)
        encoded = text.encode("utf-8", "surrogatepass")
        return {MAIN: _other_text(encoded, random) if random.random() < 0.15 else encoded}

    return mutate


def _inside(data: Any) -> list[tuple[Any, Any]]:
    """Each collection in a tree with each of its keys or positions."""
    found: list[tuple[Any, Any]] = []
    for key, value in list(data.items() if isinstance(data, dict) else enumerate(data)):
        found.append((data, key))
        if isinstance(value, dict | list):
            found += _inside(value)
    return found


def _other_value(data: Any, random: Random) -> Any:
    """Change, move, remove, repeat or nest one value of a tree."""
    places = _inside(data) if isinstance(data, dict | list) else []
    if not places:
        return data
    (holder, key), (source, at) = one_of(random, places), one_of(random, places)
    value = holder[key]
    match below(random, 8):
        case 0 | 1:
            holder[key] = one_of(random, VALUES)
        case 2:
            del holder[key]
        case 3:
            holder[key] = _copy(source[at])
        case 4 if isinstance(holder, dict):
            new = one_of(random, (at, *VALUES[:22])) if isinstance(source, dict) else str(at)
            holder[new] = holder.pop(key)
        case 5:
            for _ in range(one_of(random, (1, 2, 60))):
                value = one_of(random, ([value], {"a": value}, {str(key): value}))
            holder[key] = value
        case 6:
            many = one_of(random, (2, 3, 500, 5000))
            copies = (
                [_copy(value) for _ in range(many)] if random.random() < 0.5 else [value] * many
            )
            holder[key] = copies
        case _ if isinstance(value, int | float) and not isinstance(value, bool):
            factor = one_of(random, (-1, 0, 0.5, 1.0 + 1e-12, 3, 1e30, 1e-30))
            holder[key] = value * factor
        case _:
            holder[key] = f"{value}{one_of(random, (' ', '#', ': 1', '.x', '*2', '/0', '**9**9'))}"
    return data


def _copy(value: Any) -> Any:
    """A copy of plain data, in which nothing is repeated by reference."""
    if isinstance(value, dict):
        return {key: _copy(inner) for key, inner in value.items()}
    return [_copy(inner) for inner in value] if isinstance(value, list) else value


def _with_key(data: Any, node: Mapping[str, Any], schema: Mapping[str, Any], random: Random) -> Any:
    """A tree with a value at one place that the schema has."""
    node = _resolved(node, schema, random)
    if properties := node.get("properties"):
        data = data if isinstance(data, dict) else {}
        key = one_of(random, list(properties))
        data[key] = _with_key(data.get(key), properties[key], schema, random)
        return data
    if "items" in node and isinstance(data, list) and data and random.random() < 0.9:
        place = below(random, len(data))
        data[place] = _with_key(data[place], node["items"], schema, random)
        return data
    return _value_of(node, schema, random, 0)


def _resolved(
    node: Mapping[str, Any], schema: Mapping[str, Any], random: Random
) -> Mapping[str, Any]:
    """A node of a schema behind its references and alternatives, one of which is taken."""
    while not {"properties", "type", "enum", "const"} & node.keys():
        if "$ref" in node:
            node = schema["$defs"][node["$ref"].rpartition("/")[2]]
        elif options := node.get("anyOf") or node.get("oneOf") or node.get("allOf"):
            node = one_of(random, options)
        else:
            break
    return node


def _value_of(
    node: Mapping[str, Any], schema: Mapping[str, Any], random: Random, depth: int
) -> Any:
    """A value that a node of a schema allows, as a rule."""
    node = _resolved(node, schema, random)
    if random.random() < 0.15 or depth > 5:
        return one_of(random, VALUES)
    if "const" in node or "enum" in node:
        return node.get("const", one_of(random, node.get("enum", [None])))
    inner = partial(_value_of, schema=schema, random=random, depth=depth + 1)
    match node.get("type"):
        case "object":
            named = node.get("properties", {})
            chosen = {*node.get("required", []), *(key for key in named if random.random() < 0.2)}
            found = {key: inner(named[key]) for key in sorted(chosen & named.keys())}
            extra = node.get("additionalProperties")
            if isinstance(extra, dict):
                found |= {one_of(random, ("1", "k1", "3.x", "others")): inner(extra)}
            return found
        case "array":
            return [inner(node.get("items", {})) for _ in range(below(random, 4))]
        case "integer":
            return one_of(random, (0, 1, 2, 3, 6, 40, 10**6, -1))
        case "number":
            return one_of(random, (0.0, 0.5, 1.0, 2.0, 1e-9, 1e9, -1.0, 0.01))
        case "boolean":
            return random.random() < 0.5
        case _:
            names = ("k1", "m1", "six_mass.yaml", "measured.csv", "1 - k2", "k1 * k2", "x", "10 s")
            return one_of(random, names)


def of_records(good: bytes, random: Random) -> Files:
    """Mutations of Fortran's unformatted records: their order, number, lengths and words."""
    records, place = [], 0
    while place + 8 <= len(good):
        (length,) = struct.unpack_from("<i", good, place)
        if not 0 <= length <= len(good) - place - 8:
            break
        records.append(bytearray(good[place + 4 : place + 4 + length]))
        place += length + 8
    rest = good[place:]
    for _ in range(1 + below(random, 3)):
        one, other = (below(random, len(records)) for _ in range(2))
        word = 4 * below(random, max(1, len(records[one]) // 4))
        match below(random, 9):
            case 0:
                records[other:other] = records[span(random, len(records), 12)]
            case 1:
                records[one], records[other] = records[other], records[one]
            case 2 if len(records) > 12:
                del records[span(random, len(records), 8)]
            case 3:
                records[one] = records[one] + records[other]
            case 4:
                records[one] = records[one] * one_of(random, (2, 100, 3000))
            case 5:
                del records[one][word:]
            case 6:
                first = below(random, len(records))
                records = records[first:] + records[:first]
            case 7:
                records[one][word : word + 4] = struct.pack(
                    "<f", one_of(random, (0.0, -1e30, 1e38))
                )
            case _:
                number = one_of(random, (0, 1, -1, 2, 7, 146, 2**31 - 1, -(2**31), 10**6))
                records[one][word : word + 4] = struct.pack("<i", number)
    joined = b"".join(
        struct.pack("<i", len(record)) + record + struct.pack("<i", len(record))
        for record in records
    )
    return {MAIN: joined + rest}


def of_archive(good: bytes, random: Random) -> Files:
    """Mutations of the members of a ZIP archive; its checksums are right again."""
    with zipfile.ZipFile(io.BytesIO(good)) as archive:
        members = [(name, archive.read(name)) for name in archive.namelist()]
    for _ in range(1 + below(random, 2)):
        one, other = (below(random, len(members)) for _ in range(2))
        (name, data), (other_name, other_data) = members[one], members[other]
        match below(random, 7):
            case 0 if len(members) > 1:
                del members[one]
            case 1:
                members.append((name, other_data))
            case 2:
                members[one] = (other_name, data)
            case 3:
                members[one] = (name, data + b" " * one_of(random, (1, 10**5, 10**7)))
            case 4:
                members[one] = (name, b"")
            case _:
                spoil = spoil_bytes if random.random() < 0.5 else of_text(ROWS)
                members[one] = (name, spoil(data.replace(b"><", b">\n<"), random)[MAIN])
    made = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(made, "w", zipfile.ZIP_DEFLATED) as archive:
        warnings.simplefilter("ignore")  # two members of one name
        for name, data in members:
            archive.writestr(name, data)
    return {MAIN: made.getvalue()}


def of_workbook(good: bytes, random: Random) -> Files:
    """Mutations of the sheets, rows and cells of a workbook, or of its archive."""
    if random.random() < 0.3:
        return of_archive(good, random)
    book = load_workbook(io.BytesIO(good))
    for _ in range(1 + below(random, 4)):
        sheet = one_of(random, book.worksheets)
        row, column = 1 + below(random, sheet.max_row), 1 + below(random, sheet.max_column)
        cell = sheet.cell(row, column)
        match below(random, 10):
            case 0:
                sheet.insert_rows(row, one_of(random, (1, 2, 200)))
            case 1:
                sheet.delete_rows(row, 1 + below(random, 3))
            case 2:
                sheet.insert_cols(column)
            case 3:
                sheet.delete_cols(column)
            case 4:
                book.copy_worksheet(sheet)
            case 5:
                sheet.merge_cells(start_row=row, end_row=row + 2, start_column=1, end_column=column)
            case 6:
                far = (one_of(random, (100, 10**4, 1048576)), one_of(random, (1, 50, 16384)))
                sheet.cell(*far).value = 1
                break  # all that follows would take the whole sheet
            case 7:
                sheet.append([one.value for one in sheet[row]])
            case _ if type(cell).__name__ == "Cell":
                cells = ("=1/0", "#REF!", "=A1", "1e400", "12,5", datetime.datetime(2020, 1, 1))
                usable = [value for value in VALUES if not isinstance(value, list | dict)]
                value = one_of(random, (*cells, *usable))
                cell.value = value[:30000] if isinstance(value, str) else value
    made = io.BytesIO()
    book.save(made)
    return {MAIN: made.getvalue()}


def workbook(rows: Sequence[Sequence[Any]]) -> bytes:
    """The bytes of a workbook with these rows."""
    book, made = Workbook(), io.BytesIO()
    for row in rows:
        book.active.append(list(row))
    book.save(made)
    return made.getvalue()


def _other_array(array: Any, random: Random) -> Any:
    """An array of another shape, type or value."""
    array = np.array(array)
    match below(random, 9):
        case 0:
            return array.T
        case 1:
            return array.reshape(-1)
        case 2:
            return array[:0]
        case 3:
            return np.concatenate([array.reshape(-1)] * one_of(random, (2, 300)))
        case 4:
            return array.reshape(*array.shape, 1, 1).repeat(2, axis=-1)
        case 5:
            return array.reshape(-1)[: 1 + below(random, max(1, array.size))]
        case 6 if array.dtype.kind in "iufc":
            types = ("i1", "u8", "f4", "c16", "?", "S5")
            with np.errstate(all="ignore"), warnings.catch_warnings():
                warnings.simplefilter("ignore")
                return array.astype(one_of(random, types))
        case _ if array.dtype.kind in "iuf" and array.size:
            array = array.astype(np.float64)
            numbers = (0.0, -1.0, np.nan, np.inf, 1e300, 1e-320, 0.5, 2.0**63)
            array.reshape(-1)[span(random, array.size, 3)] = one_of(random, numbers)
            return array
        case _:
            return np.float64(3.0)


def of_mat(good: bytes, random: Random) -> Files:
    """Mutations of the variables of a MATLAB file of version 5, written as 4 or 5."""
    loaded = loadmat(io.BytesIO(good))  # type: ignore[arg-type]  # a stream
    variables = {name: value for name, value in loaded.items() if not name.startswith("__")}
    for _ in range(1 + below(random, 3)):
        one, other = (one_of(random, sorted(variables)) for _ in range(2))
        match below(random, 6):
            case 0 if len(variables) > 1:
                del variables[one]
            case 1:
                variables[other], variables[one] = variables[one], variables[other]
            case 2:
                variables[one[:30] + one_of(random, ("2", "_x", "Hz"))] = variables[one]
            case 3:
                cell = np.empty((1, 3), dtype=object)
                cell[0, :] = [variables[one], variables[other], "text"]
                variables[one] = one_of(random, (cell, {"a": variables[other], "b": "x"}, "text"))
            case _ if isinstance(variables[one], np.ndarray):
                variables[one] = _other_array(variables[one], random)
    try:
        return {MAIN: mat_file(variables, one_of(random, ("5", "5", "4")), bool(below(random, 2)))}
    except (TypeError, ValueError, NotImplementedError):  # nothing that version 4 has
        return {MAIN: mat_file(variables)}


def mat_file(variables: Mapping[str, Any], version: Any = "5", packed: bool = False) -> bytes:
    """The bytes of a MATLAB file of version 4 or 5."""
    made = io.BytesIO()
    savemat(made, variables, format=version, do_compression=packed)  # type: ignore[arg-type]  # a stream
    return made.getvalue()


def of_hdf5(good: bytes, random: Random) -> Files:
    """Mutations of the datasets, groups and attributes of an HDF5 file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "f.h5"
        path.write_bytes(good)
        with h5py.File(path, "r+") as file:
            for _ in range(1 + below(random, 2)):
                names: list[str] = []
                file.visit(names.append)
                if names:
                    _other_node(file, one_of(random, names), one_of(random, names), random)
        return {MAIN: path.read_bytes()}


def _other_node(file: Any, name: str, other: str, random: Random) -> None:
    """Change, remove, move, or link a dataset or group."""
    node, keys = file[name], sorted(file[name].attrs)
    match below(random, 8):
        case 0:
            del file[name]
        case 1 if f"{name}_2" not in file:
            file[f"{name}_2"] = node
        case 2 if other != name and not other.startswith(name) and not name.startswith(other):
            del file[other]
            file[other] = node
        case 3:
            del file[name]
            target = one_of(random, (name, f"/{other}", "/nothing"))
            file[name] = one_of(random, (h5py.SoftLink(target), h5py.ExternalLink("x.h5", target)))
        case 4 if keys:
            node.attrs[one_of(random, keys)] = one_of(random, (0, -1, "x", np.zeros(3), 1e300))
        case 5:
            del file[name]
            file.create_dataset(name, shape=(0,), maxshape=(None,), dtype="f8")
        case 6:
            del file[name]
            file.create_dataset(name, shape=(40_000, 40_000), dtype="f8", chunks=(100, 100))
        case _ if isinstance(node, h5py.Dataset) and node.size is not None and node.size < 10**6:
            values = node[()]
            del file[name]
            changed = _other_array(values, random)
            try:
                file[name] = changed
            except (TypeError, ValueError):  # no type of HDF5
                file[name] = np.arange(3.0)
