"""One instance's life: what is to be done next is decided from what OSM says, until it is as wanted.

Nothing is remembered here: whoever goes on after a crash, or after an answer that was lost, decides the same.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from scan2sim.pipeline.core.errors import StepError
from scan2sim.services.orchestration.instance import DONE, RUNNING, Action, Instance, Wanted, next_action
from scan2sim.services.orchestration.osm import INSTANCES, PASSING, Osm, Refused, Unsure, pause

Say = Callable[[str], None]
"""Told what happens."""
Stop = Callable[[], bool]
"""Whether to begin nothing more."""

POLL = 1.0
"""Seconds between two looks at an operation, at first, and `LONGEST_POLL` at last."""
LONGEST_POLL = 5.0
LOST = 5
"""Answers that may be lost in a row."""
BEGUN = (Action.INSTANTIATE, Action.UPGRADE, Action.SCALE_OUT, Action.SCALE_IN)
"""Actions that need not be waited for."""


Find = Callable[[], Instance | None]
"""Looks at what is there of an instance."""


class Failed(StepError):
    """An operation that OSM began and gave up.

    Attributes:
        kind: of the operation.
    """

    def __init__(self, where: str, cause: str, remedy: str, kind: str = "") -> None:
        super().__init__(where, cause, remedy)
        self.args = (where, cause, remedy, kind)
        self.kind = kind


@dataclass(frozen=True)
class Patience:
    """How long to wait.

    Attributes:
        timeout: seconds for an operation.
        wait: whether operations are waited for at all, beyond what must be.
        stop: asked between two steps.
    """

    timeout: float = 1800.0
    wait: bool = True
    stop: Stop = lambda: False


def find(osm: Osm, name: str) -> Instance | None:
    """An instance by its name or id; None: there is none.

    Raises:
        StepError: there are several.
    """
    found = [one for one in osm.instances() if name in (one.get("name"), one.get("_id"))]
    if len(found) > 1:
        ids = ", ".join(str(one["_id"]) for one in found)
        raise StepError(name, f"there are {len(found)} instances of that name", f"Name one by its id: {ids}")
    return look(osm, found[0]) if found else None


def find_own(osm: Osm, name: str, deployment: str) -> Instance | None:
    """A deployment's instance by its name, the oldest where an answer that was lost has left two; None: there is none.

    Raises:
        StepError: the name is that of another one's instance.
    """
    found = [one for one in osm.instances() if one.get("name") == name]
    own = [one for one in found if Instance.of(one, ()).is_of(deployment)]
    if found and not own:
        cause = "is the name of an instance that isn't this deployment's"
        raise StepError(name, cause, "Choose another name, or delete it: scan2sim orchestrate delete")
    return look(osm, min(own, key=lambda one: one.get("create-time", 0))) if own else None


def look(osm: Osm, record: Mapping[str, Any]) -> Instance:
    """An instance with its operations, of what a list says of it.

    Its record is asked for after them: one of them may end in between, and be taken for done too early else.
    """
    operations = osm.operations(str(record["_id"]))
    return Instance.of(osm.instance(str(record["_id"])), operations)


def bring(osm: Osm, there: Find, wanted: Wanted | None, record: str, patience: Patience, say: Say) -> None:
    """Make an instance as wanted; None: have none.

    Args:
        there: looks at the instance.
        record: of its network service's descriptor, in OSM.

    Raises:
        Failed: OSM gave up. StepError: it takes too long, or the name is another one's. Refused: as `Osm`.
    """
    failure: Failed | None = None
    lost = 0
    while not patience.stop():
        try:
            found = there()
            action = next_action(None if failure else wanted, found)
            if action is None:
                break
            say(_told(action, found, wanted))
            _act(osm, action, found, wanted, record, patience)
            lost = 0
            if not patience.wait and action in BEGUN:
                break
        except Failed as error:
            if failure or wanted is None or error.kind != "instantiate":
                raise
            failure = error  # what is half made is taken down before that is said
            say(f"{error.cause}; it is taken down")
        except (Unsure, Refused) as error:
            lost += 1
            if lost > LOST or (isinstance(error, Refused) and error.status not in PASSING):
                raise
            pause(lost - 1)
    if failure:
        raise failure


def _told(action: Action, there: Instance | None, wanted: Wanted | None) -> str:
    if action == Action.FOLLOW and there and there.running:
        return f"waits for its {there.running.get('lcmOperationType')}"
    again = there is not None and wanted is not None and action in (Action.TERMINATE, Action.DELETE)
    return f"{action}{', to make it anew' if again else ''}"


def _act(
    osm: Osm, action: Action, there: Instance | None, wanted: Wanted | None, record: str, patience: Patience
) -> None:
    """Do one thing, and wait for its end."""
    if action == Action.CREATE:
        assert wanted
        osm.create(wanted.request(record))
        return
    assert there
    if action == Action.FOLLOW:
        assert there.running
        follow(osm, there.name, str(there.running["_id"]), patience)
    elif action == Action.DELETE:
        osm.remove(INSTANCES, there.id)
    elif action == Action.TERMINATE:
        follow(osm, there.name, osm.act(there.id, "terminate", {}), patience)
    else:
        assert wanted
        new = action == Action.INSTANTIATE
        what, body = ("instantiate", wanted.request(record)) if new else wanted.change(action)
        operation = osm.act(there.id, what, body)
        if patience.wait:
            follow(osm, there.name, operation, patience)


def follow(osm: Osm, name: str, operation: str, patience: Patience, say: Say = lambda _: None) -> None:
    """Wait for an operation's end.

    Raises:
        Failed: it failed. StepError: it takes longer than `patience.timeout`.
    """
    ends, pause = time.monotonic() + patience.timeout, POLL
    while not patience.stop():
        told = osm.operation(operation)
        kind, state = str(told.get("lcmOperationType")), str(told.get("operationState"))
        if state in DONE:
            return
        detail = str(told.get("errorMessage") or told.get("detailed-status") or "")[:300]
        if state not in RUNNING:
            cause = f"OSM gave up its {kind} ({state}: {detail or 'no reason given'})"
            raise Failed(name, cause, "Its lifecycle manager's log says why; mend it and run again", kind)
        say(f"{kind} {detail}".strip())
        if time.monotonic() > ends:
            cause = f"its {kind} isn't over after {patience.timeout:g} s{f' ({detail})' if detail else ''}"
            raise StepError(name, cause, "Run again to go on waiting; nothing was undone")
        time.sleep(pause)
        pause = min(LONGEST_POLL, 1.2 * pause)
