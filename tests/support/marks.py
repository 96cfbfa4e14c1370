"""A plugin of pytest that prints what is collected, a line each, and which tests are slow."""

from __future__ import annotations

import pytest

LISTED, SLOW = "collected: ", "  # slow"
"""Before the name of each test, and behind that of a slow one."""


def pytest_collection_finish(session: pytest.Session) -> None:
    for item in session.items:
        slow = item.get_closest_marker("slow") is not None
        print(f"{LISTED}{item.nodeid}{SLOW if slow else ''}")
