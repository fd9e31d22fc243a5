"""Reconcile one instance: repeat the next action, chosen from OSM's current state, until the desired state is reached.

No state is kept on this side, so that a run after a crash or a lost response continues in the same way.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from scan2sim.pipeline.core.errors import StepError
from scan2sim.services.orchestration.instance import DONE, RUNNING, Action, DesiredInstance, Instance, next_action
from scan2sim.services.orchestration.osm import (
    INSTANCES,
    OPERATIONS,
    Osm,
    OsmError,
    ResponseLost,
    back_off,
    is_transient,
)
from scan2sim.services.orchestration.records import InstanceRecord

Notify = Callable[[str], None]
"""Called with progress messages."""
Stop = Callable[[], bool]
"""Returns True if no further action is to be started."""

POLL_INTERVAL_S = 1.0
"""First and longest interval between two queries of an operation's state, seconds."""
MAX_POLL_INTERVAL_S = 5.0
MAX_LOST_RESPONSES = 5
"""Maximum number of consecutive lost responses."""
ASYNC_ACTIONS = (Action.INSTANTIATE, Action.UPGRADE, Action.SCALE_OUT, Action.SCALE_IN)
"""Actions that are only awaited with `WaitPolicy.wait`."""


FindInstance = Callable[[], Instance | None]
"""Returns the current state of an instance."""


class OperationFailed(StepError):
    """An operation that failed in OSM.

    Attributes:
        kind: type of the operation.
    """

    def __init__(self, where: str, cause: str, remedy: str, kind: str = "") -> None:
        super().__init__(where, cause, remedy)
        self.args = (where, cause, remedy, kind)
        self.kind = kind


@dataclass(frozen=True)
class WaitPolicy:
    """How long to wait for operations.

    Attributes:
        timeout: timeout of one operation in seconds.
        wait: wait for every operation, not only for those that the next action depends on.
        stop: checked before each action.
    """

    timeout: float = 1800.0
    wait: bool = True
    stop: Stop = lambda: False


def find(osm: Osm, name: str) -> Instance | None:
    """An instance by its name or id; None if there is none.

    Raises:
        StepError: more than one instance has this name.
    """
    found = [one for one in osm.instances() if name in (one.name, one.record)]
    if len(found) > 1:
        ids = ", ".join(one.record for one in found)
        raise StepError(name, f"{len(found)} instances have this name", f"Choose one by its id: {ids}")
    return load_instance(osm, found[0]) if found else None


def find_owned(osm: Osm, name: str, deployment: str) -> Instance | None:
    """A deployment's instance by its name; None if there is none. The oldest if a lost response has left duplicates.

    Raises:
        StepError: an instance of another owner has this name.
    """
    found = [one for one in osm.instances() if one.name == name]
    own = [one for one in found if Instance.of(one, ()).belongs_to(deployment)]
    if found and not own:
        cause = "the name belongs to an instance of another deployment"
        raise StepError(name, cause, "Choose another name, or delete it: scan2sim orchestrate delete")
    return load_instance(osm, min(own, key=lambda one: one.created)) if own else None


def load_instance(osm: Osm, record: InstanceRecord) -> Instance:
    """An instance with its operations, from an entry of a list.

    Its record is read after the operations: if one of them ended in between, its effect would be missed otherwise.
    """
    operations = osm.operations(record.record)
    return Instance.of(osm.instance(record.record), operations)


def reconcile(
    osm: Osm,
    find_instance: FindInstance,
    desired: DesiredInstance | None,
    record: str,
    wait_policy: WaitPolicy,
    notify: Notify,
) -> None:
    """Bring an instance to its desired state; None removes it.

    Args:
        find_instance: returns the current state of the instance.
        record: id of its descriptor's record in OSM.

    Raises:
        OperationFailed: OSM reports a failure. StepError: timeout, or the name belongs to another owner.
        OsmError: see `Osm`.
    """
    failure: OperationFailed | None = None
    lost, done = 0, set[tuple[object, ...]]()
    while not wait_policy.stop():
        try:
            found = find_instance()
            action = next_action(None if failure else desired, found)
            if action is None:
                break
            step = (action, *(found.condition if found else ()))
            if step in done:
                cause = f"OSM reported the success of `{action}`, but the instance is as before"
                raise StepError(found.name if found else record, cause, "See the log of OSM's lifecycle manager")
            notify(_progress_message(action, found, desired))
            _act(osm, action, found, desired, record, wait_policy)
            done.add(step)
            lost = 0
            if not wait_policy.wait and action in ASYNC_ACTIONS:
                break
        except OperationFailed as error:
            if failure or desired is None or error.kind != "instantiate":
                raise
            failure = error  # raised after the incomplete instance has been removed
            notify(f"{error.cause}; removing the incomplete instance")
        except (ResponseLost, OsmError) as error:
            lost += 1
            if lost > MAX_LOST_RESPONSES or not is_transient(error):
                raise
            notify(f"{error.cause}; trying again")
            back_off(lost - 1)
    if failure:
        raise failure


def _progress_message(action: Action, observed: Instance | None, desired: DesiredInstance | None) -> str:
    if action == Action.WAIT and observed and observed.running_operation:
        return f"waiting for its {observed.running_operation.kind}"
    recreated = observed is not None and desired is not None and action in (Action.TERMINATE, Action.DELETE)
    return f"{action}{', to recreate it' if recreated else ''}"


def _act(
    osm: Osm,
    action: Action,
    observed: Instance | None,
    desired: DesiredInstance | None,
    record: str,
    wait_policy: WaitPolicy,
) -> None:
    """Run one action and wait for its end."""
    if action == Action.CREATE:
        assert desired
        osm.create(desired.request(record))
        return
    assert observed
    if action == Action.WAIT:
        assert observed.running_operation
        wait_for_operation(osm, observed.name, observed.running_operation.record, wait_policy)
    elif action == Action.DELETE:
        osm.remove(INSTANCES, observed.id)
    elif action == Action.TERMINATE:
        wait_for_operation(osm, observed.name, osm.start_operation(observed.id, "terminate", {}), wait_policy)
    else:
        assert desired
        new = action == Action.INSTANTIATE
        kind, body = ("instantiate", desired.request(record)) if new else desired.change_request(action)
        operation = osm.start_operation(observed.id, kind, body)
        if wait_policy.wait:
            wait_for_operation(osm, observed.name, operation, wait_policy)


def wait_for_operation(
    osm: Osm,
    name: str,
    operation: str,
    wait_policy: WaitPolicy,
    notify: Notify = lambda _: None,
    collection: str = OPERATIONS,
) -> None:
    """Wait until an operation in a collection has ended.

    Raises:
        OperationFailed: it failed. StepError: it exceeds `wait_policy.timeout`.
    """
    ends, interval, lost = time.monotonic() + wait_policy.timeout, POLL_INTERVAL_S, 0
    while not wait_policy.stop():
        try:
            record = osm.operation(operation, collection)
            lost = 0
        except (ResponseLost, OsmError) as error:
            lost += 1
            if lost > MAX_LOST_RESPONSES or not is_transient(error):
                raise
            notify(f"{error.cause}; trying again")
            back_off(lost - 1)
            continue
        if record.state in DONE:
            return
        detail = (record.error or record.status)[:300]
        if record.state not in RUNNING:
            cause = f"OSM's {record.kind} failed ({record.state or 'no state'}: {detail or 'no reason given'})"
            raise OperationFailed(
                name, cause, "See the log of OSM's lifecycle manager; fix the cause and run again", record.kind
            )
        notify(f"{record.kind} {detail}".strip())
        if time.monotonic() > ends:
            cause = f"{record.kind} still running after {wait_policy.timeout:g} s{f' ({detail})' if detail else ''}"
            raise StepError(name, cause, "Run again to continue waiting; nothing was undone")
        time.sleep(interval)
        interval = min(MAX_POLL_INTERVAL_S, 1.2 * interval)
