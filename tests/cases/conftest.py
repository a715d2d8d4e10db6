"""The cases are watched as the campaigns of flows are."""

from tests.flows.conftest import watcher as watcher
