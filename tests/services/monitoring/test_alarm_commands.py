"""Commands of people to the alarm node: who gives them."""

from __future__ import annotations

import os

import pytest

from scan2sim.services.monitoring.events.alarm_commands import command_of
from scan2sim.services.monitoring.settings.bus import RetireParams


@pytest.mark.parametrize("error", [KeyError("uid not found"), OSError("No username set in the environment")])
def test_users_of_containers_need_no_name(error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown() -> str:
        raise error

    monkeypatch.setattr("getpass.getuser", unknown)
    assert command_of(RetireParams(node="/camera")).by == f"user {os.getuid()}"
    assert command_of(RetireParams(node="/camera", by="Ada")).by == "Ada"
