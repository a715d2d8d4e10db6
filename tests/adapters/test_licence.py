"""What says that no licence was free is found in a program's files, also by a site's words."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from modetune.adapters.licence import licence_denied, licence_refusal
from modetune.adapters.process import LOG


@pytest.mark.parametrize("name", [LOG, "job.f04", "run.LOG", "job.msg", "out.err"])
def test_a_refusal_is_found_in_any_programs_files(tmp_path: Path, name: str) -> None:
    (tmp_path / "job.dat").write_text("could not check out license\n")  # a deck, not a log
    (tmp_path / LOG).write_text("starting\n")
    assert licence_refusal(tmp_path) == ""
    (tmp_path / name).write_text("starting\n *** Could not checkout license for FOO ***\n")
    assert licence_refusal(tmp_path) == "Could not checkout license for FOO"


def test_a_sites_own_words_are_found_in_any_case(tmp_path: Path) -> None:
    (tmp_path / LOG).write_text("starting\n  ERROR 42: no Token left for user ada\n")
    assert licence_refusal(tmp_path) == ""
    assert licence_refusal(tmp_path, ["no token LEFT"]) == "ERROR 42: no Token left for user ada"
    assert licence_denied("** no token left", ["no token left"]) == ""  # a comment of a deck


def test_what_is_no_file_is_passed_over(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.log")
    (tmp_path / "folder.log").mkdir()
    assert licence_refusal(tmp_path) == ""
