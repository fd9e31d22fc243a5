"""Commands of people to the alarm node, by Kafka if it is given, else by ROS 2."""

from __future__ import annotations

import getpass
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from scan2sim.pipeline.core.errors import UnavailableError
from scan2sim.services.kafka import Cluster
from scan2sim.services.monitoring.events.bus import RosOutlet
from scan2sim.services.monitoring.events.schema import AlarmCommand, Events
from scan2sim.services.monitoring.export.sinks import KafkaSink
from scan2sim.services.monitoring.node.monitor import ros
from scan2sim.services.monitoring.settings.bus import AcknowledgeParams, AlarmCommandParams, MuteParams, RetireParams
from scan2sim.services.outbox import Outbox

TIMEOUT_S = 10.0
"""Time to reach the alarm node on ROS 2, or Kafka."""


def command_of(params: AlarmCommandParams) -> AlarmCommand:
    """The command that a user's parameters mean; without a name, by the user who is logged in."""
    by = params.by or _user()
    if isinstance(params, RetireParams):
        return AlarmCommand(action="retire", subject=params.node, by=by)
    if isinstance(params, MuteParams):
        until = time.time() + params.seconds
        return AlarmCommand(action="mute", rule=params.rule, subject=params.subject, by=by, until=until)
    assert isinstance(params, AcknowledgeParams)
    return AlarmCommand(action="acknowledge", rule=params.rule, subject=params.subject, by=by)


def _user() -> str:
    """Name of the user who is logged in, or its number where it has no name, as in a container."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return f"user {os.getuid()}"


def send(params: AlarmCommandParams) -> None:
    """Send a command.

    Raises:
        UnavailableError: neither Kafka nor, without it, a program on ROS 2 takes the command within ten seconds.
        InputError: the file of Kafka options is invalid.
    """
    if params.kafka_bootstrap_servers:
        cluster = Cluster.read(params.kafka_bootstrap_servers, params.kafka_config)
        taken = send_by_kafka(cluster, params.events_topic, command_of(params))
        cause = f"Kafka at {params.kafka_bootstrap_servers} doesn't take the command"
    else:
        taken, cause = _send_by_ros(params), "no program on ROS 2 takes the command"
    if not taken:
        raise UnavailableError("the alarm node", cause, "Start `scan2sim monitor alarms`, or name its --kafka")


def send_by_kafka(cluster: Cluster, topic: str, command: AlarmCommand) -> bool:
    """Send a command on a topic of events; whether Kafka has taken it within ten seconds."""
    with tempfile.TemporaryDirectory() as folder:
        outbox = Outbox(Path(folder) / "command.outbox")  # a command that isn't taken now must not be sent later
        sink = KafkaSink(cluster, topic, outbox)
        events = Events("alarm_command")
        events.outlets.append(sink)
        events.send("alarm_command", command)
        taken = _wait(lambda: not len(outbox))
        sink.close()
    return taken


def _send_by_ros(params: AlarmCommandParams) -> bool:
    ros.init()
    node = ros.Node("_alarm_command", hidden=True)
    outlet, events = RosOutlet(node, params.events_topic), Events("alarm_command")
    events.outlets.append(outlet)
    taken = _wait(outlet.is_heard)
    if taken:
        events.send("alarm_command", command_of(params))
        taken = outlet.is_delivered(TIMEOUT_S)
    node.destroy_node()
    ros.shutdown()
    return taken


def _wait(is_done: Callable[[], bool]) -> bool:
    """Whether a condition becomes true in time."""
    end = time.monotonic() + TIMEOUT_S
    while not is_done():
        if time.monotonic() > end:
            return False
        time.sleep(0.05)
    return True
