"""A plugin of pytest: what it collects is listed with which tests are slow."""

from __future__ import annotations

import pytest

SLOW = "  # slow"
"""Behind the name of such a test."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if item.get_closest_marker("slow") is not None:
            item._nodeid += SLOW
