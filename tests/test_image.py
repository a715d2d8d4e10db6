"""The container files without an engine; tools/image_in_root.py carries the steps out."""

from __future__ import annotations

import re
from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parents[1]
DOCKERFILE = (ROOT / "Dockerfile").read_text()
COMPOSE = yaml.safe_load((ROOT / "compose.yaml").read_text())


def test_the_image_runs_as_an_ordinary_user_with_pinned_packages() -> None:
    last_stage = DOCKERFILE.rsplit("FROM ", 1)[1]
    assert re.search(r"^USER modetune$", last_stage, re.MULTILINE)
    assert "calculix-ccx" in last_stage
    assert "--constraint constraints.txt" in DOCKERFILE
    pinned = (ROOT / "tools" / "constraints.txt").read_text().splitlines()[1:]
    assert all(re.fullmatch(r"[\w.\[\]-]+==[\w.+!]+", line) for line in pinned)


def test_everything_the_image_copies_is_there() -> None:
    copies = re.findall(r"^COPY (?!--from)(.+)$", DOCKERFILE, re.MULTILINE)
    names = [name for line in copies for name in line.split()[:-1]]
    assert len(names) > 5
    assert all((ROOT / name).exists() for name in names)


def test_compose_shows_the_server_on_loopback_only_and_holds_no_secret() -> None:
    ports = {name: service.get("ports", []) for name, service in COMPOSE["services"].items()}
    assert ports == {"database": [], "server": ["127.0.0.1:4200:4200"], "worker": []}
    assert COMPOSE["networks"]["inside"] == {"internal": True}
    assert COMPOSE["services"]["database"]["networks"] == ["inside"]
    for service in COMPOSE["services"].values():
        for name, value in service.get("environment", {}).items():
            if re.search("PASSWORD|AUTH|CONNECTION_URL", name):
                assert "${MODETUNE_" in value
                assert ":?" in value  # refuses to start without
