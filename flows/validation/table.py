"""What a person sees on a terminal of modes that were held out: a table, red where it got worse."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from modetune.core.held_out import HeldOut
from modetune.core.numbering import mode_name

WORSE = "bold red"


def show_held_out(console: Console, held: HeldOut | None, configurations: Sequence[str]) -> None:
    """Table and sentences; nothing where nothing was held out."""
    if held is None:
        return
    console.print(held_out_table(held, configurations))
    for line in held_out_lines(held, configurations):
        console.print(Text(line, style=WORSE), soft_wrap=True)


def held_out_table(held: HeldOut, configurations: Sequence[str]) -> Table:
    """Held-out modes before and after."""
    table = Table(title="Held out: not used for updating", title_justify="left")
    table.add_column("test")
    for heading in ("test Hz", "before Hz", "error %", "after Hz", "error %", "MAC", "after"):
        table.add_column(heading, justify="right")
    table.add_column("")
    for mode, number in enumerate(held.numbers.tolist()):
        table.add_row(
            mode_name(configurations, number),
            f"{held.test_hz[mode]:.2f}",
            _shown(held.initial_hz[mode], ".2f"),
            _shown(100.0 * held.error_initial[mode], "+.2f"),
            _shown(held.updated_hz[mode], ".2f"),
            _shown(100.0 * held.error_updated[mode], "+.2f"),
            _shown(held.mac_initial[mode], ".3f"),
            _shown(held.mac_updated[mode], ".3f"),
            "worse" if held.worse[mode] else "",
            style=WORSE if held.worse[mode] else None,
        )
    return table


def held_out_lines(held: HeldOut, configurations: Sequence[str]) -> list[str]:
    """A sentence for each held-out mode that got worse."""
    return [
        f"{mode_name(configurations, number)}, held out, got worse: it {held.reason(mode)}"
        for mode, number in enumerate(held.numbers.tolist())
        if held.worse[mode]
    ]


def _shown(value: float, form: str) -> str:
    return format(value, form) if np.isfinite(value) else "-"
