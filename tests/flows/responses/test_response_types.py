"""Response types: each is two files of one name, and no other room of the campaign names it."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path

from modetune.flows.responses.residuals import ResidualSection, response_types

FLOWS = Path(__file__).resolve().parents[3] / "flows"
#: Files of the room that serve all types.
SEAM = {"__init__", "section", "response", "residuals", "gauges"}
#: Those without a key: functions of the user, which no campaign file holds.
IN_PYTHON = {"own"}


def test_a_type_is_two_files_with_the_name_of_its_key() -> None:
    for key, section in response_types().items():
        assert section.__module__ == f"modetune.flows.responses.{key}"
        mathematics = import_module(f"modetune.core.updating.responses.{key}")
        classes = [item for item in vars(mathematics).values() if isinstance(item, type)]
        own = [item for item in classes if item.__module__ == mathematics.__name__]
        assert {item.kind for item in own if hasattr(item, "kind")} == {key}


def test_every_file_of_the_room_is_a_type_or_serves_all() -> None:
    files = {path.stem for path in (FLOWS / "responses").glob("*.py")}
    assert files == SEAM | IN_PYTHON | set(response_types())


def test_types_follow_the_keys_of_frequencies_and_shapes_in_the_order_of_their_rows() -> None:
    keys = list(ResidualSection.model_fields)
    assert keys[-len(response_types()) :] == list(response_types())


def test_the_campaign_imports_no_type() -> None:
    types = re.compile(rf"flows\.responses\.({'|'.join(response_types())})\b")
    named = {
        path.name
        for path in (FLOWS / "campaign").glob("*.py")
        if types.search(path.read_text(encoding="utf-8"))
    }
    assert named == set()
