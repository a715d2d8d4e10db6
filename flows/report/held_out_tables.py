"""The table of modes that took no part in updating, before and after."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from modetune.core.correlation.held_out import HeldOut
from modetune.flows.report.tables import Column, Table, table_of


@dataclass(frozen=True, slots=True)
class HeldOutRow:
    """A mode that took no part in updating, before and after; NaN where it was not found."""

    test: int
    configuration: str | None
    label: Annotated[str, Column("test")]
    test_hz: Annotated[float, Column("test", "Hz")]
    initial_hz: Annotated[float, Column("before", "Hz")]
    error_initial: Annotated[float, Column("error before", "%", "+.2f")]
    updated_hz: Annotated[float, Column("after", "Hz")]
    error_updated: Annotated[float, Column("error after", "%", "+.2f")]
    mac_initial: Annotated[float, Column("MAC before", form=".3f")]
    mac_updated: Annotated[float, Column("MAC after", form=".3f")]
    worse: Annotated[bool, Column("got worse")]


def held_out_rows(held: HeldOut | None) -> tuple[HeldOutRow, ...]:
    """Every mode that was held out; none where nothing was."""
    if held is None:
        return ()
    return tuple(
        HeldOutRow(
            test=number,
            configuration=held.configurations[mode] if held.configurations else None,
            label=held.names[mode],
            test_hz=float(held.test_hz[mode]),
            initial_hz=float(held.initial_hz[mode]),
            error_initial=float(held.error_initial[mode]),
            updated_hz=float(held.updated_hz[mode]),
            error_updated=float(held.error_updated[mode]),
            mac_initial=float(held.mac_initial[mode]),
            mac_updated=float(held.mac_updated[mode]),
            worse=bool(held.worse[mode]),
        )
        for mode, number in enumerate(held.numbers.tolist())
    )


def held_out_table(held: HeldOut | None) -> Table:
    """Modes that were held out, before and after; those that got worse are outside."""
    rows = held_out_rows(held)
    worse = [(place, "") for place, row in enumerate(rows) if row.worse]
    return table_of("Held out: not used for updating", rows, HeldOutRow, outside=worse)


def held_out_lines(held: HeldOut | None) -> list[str]:
    """A sentence for each held-out mode that got worse."""
    return (
        []
        if held is None
        else [
            f"{name}, held out, got worse: it {held.reason(mode)}"
            for mode, name in enumerate(held.names)
            if held.worse[mode]
        ]
    )
