"""`scan2sim monitor`: monitoring of ROS 2 topics, alarms, archive and autoscaling (services/monitoring)."""

from __future__ import annotations

import signal
import sys
import threading
from pathlib import Path
from typing import Annotated, Any

import typer

from scan2sim.flows.commands.app import App
from scan2sim.flows.commands.display import console, warn
from scan2sim.flows.commands.options import options
from scan2sim.flows.commands.ros_spin import spin, stop_on_signal
from scan2sim.pipeline.core import optional_deps
from scan2sim.services.monitoring.autoscale.traffic_model import TrafficParams
from scan2sim.services.monitoring.embedded_broker import BrokerParams
from scan2sim.services.monitoring.settings.archive import ArchiveParams, QueryParams
from scan2sim.services.monitoring.settings.bus import (
    AcknowledgeParams,
    AlarmCommandParams,
    AlarmsParams,
    MuteParams,
    PoolParams,
    RetireParams,
    ScaleParams,
)
from scan2sim.services.monitoring.settings.dashboard import PageParams
from scan2sim.services.monitoring.settings.monitor import (
    DatasetParams,
    ListenerParams,
    TalkerParams,
    TopicParams,
    WorkParams,
)

app = App(
    "Monitor ROS 2 topics and publish their statistics; alarms, archive, autoscaling.",
    requirement=("the event bus", "psutil"),
)

NODE_OPTIONS = {
    "window_size": "--window",
    "kafka_bootstrap_servers": "--kafka",
    "publisher_topic": "--to",
    "log_file": "--log",
    "prometheus_port": "--metrics",
}
"""Fields of instrumented nodes' parameters with other names on the command line."""
Limits = Annotated[
    list[str] | None, typer.Option("--limit", metavar="KEY=VALUE", help=PageParams.model_fields["limit"].description)
]
BUS_OPTIONS = {"kafka_bootstrap_servers": "--kafka", "log_file": "--log"}


@app.command("broker")
@options(BrokerParams)
def monitor_broker(params: BrokerParams) -> None:
    """Run a Kafka broker on this machine to try the event bus; it keeps records in memory only."""
    from scan2sim.services.monitoring.embedded_broker import serve

    def interrupt(*_: Any) -> None:
        raise KeyboardInterrupt

    signal.signal(signal.SIGTERM, interrupt)
    serve(params, lambda text: console.print(text, highlight=False, markup=False))


@app.command("topic")
@options(TopicParams, topics="TOPIC...", **NODE_OPTIONS)
def monitor_topic(params: TopicParams, limit: Limits = None) -> None:
    """Monitor existing topics: publish bandwidth, message counts, losses and latency of each every period."""
    from scan2sim.services.monitoring.node.topic_monitor import TopicMonitor

    def create() -> Any:
        node = TopicMonitor(params)
        if not params.type:
            try:
                node.find(params.timeout, lambda text: console.print(text, highlight=False, markup=False))
            except BaseException:
                node.destroy_node()
                raise
        return node

    spin(create)


@app.command("talker")
@options(TalkerParams, **NODE_OPTIONS)
def monitor_talker(params: TalkerParams, limit: Limits = None) -> None:
    """Test node: publish text messages of a given size at a given interval."""
    from scan2sim.services.monitoring.example_nodes.talker import Talker

    spin(lambda: Talker(params))


@app.command("dataset-talker")
@options(DatasetParams, **NODE_OPTIONS)
def monitor_dataset_talker(params: DatasetParams, limit: Limits = None) -> None:
    """Test node: publish messages at the times and with the sizes listed in a CSV file."""
    from scan2sim.services.monitoring.example_nodes.dataset_talker import DatasetTalker

    spin(lambda: DatasetTalker(params), lambda node: node.finished)


@app.command("listener")
@options(ListenerParams, **NODE_OPTIONS)
def monitor_listener(params: ListenerParams, limit: Limits = None) -> None:
    """Test node: subscribe to text messages and log them."""
    from scan2sim.services.monitoring.example_nodes.listener import Listener

    spin(lambda: Listener(params))


@app.command("traffic")
@options(TrafficParams, cameras="--cameras", from_hour="--from", to_hour="--to")
def monitor_traffic(params: TrafficParams) -> None:
    """Generate random camera events over some hours of a day, as a CSV file for `dataset-talker`."""
    from scan2sim.services.monitoring.autoscale.traffic_model import write

    count = write(params)
    console.print(f"{count} events of {params.cameras} cameras in {params.out}", highlight=False, markup=False)


@app.command("work")
@options(WorkParams, command="WORKER", **NODE_OPTIONS)
def monitor_work(params: WorkParams, limit: Limits = None) -> None:
    """Process the events of a topic in local worker processes; `monitor scale` sets their number."""
    from scan2sim.services.monitoring.work.worker_node import WorkerNode

    spin(lambda: WorkerNode(params))


@app.command("scale")
@options(ScaleParams, **BUS_OPTIONS)
def monitor_scale(params: ScaleParams) -> None:
    """Autoscaler: request workers according to the load of the queues reported on the bus."""
    from scan2sim.services.monitoring.autoscale.node import ScalerNode

    spin(lambda: ScalerNode(params))


@app.command("pool")
@options(PoolParams, **BUS_OPTIONS)
def monitor_pool(params: PoolParams) -> None:
    """Start and stop workers of a Prefect work pool as the autoscaler requests them."""
    from scan2sim.services.monitoring.autoscale.actuators.prefect import PrefectWorkers
    from scan2sim.services.monitoring.autoscale.pool_node import PoolNode

    spin(lambda: PoolNode(params, params.queue or params.pool, PrefectWorkers(params.pool)))


@app.command("alarms")
@options(AlarmsParams, **BUS_OPTIONS)
def monitor_alarms(params: AlarmsParams) -> None:
    """Check the published statistics against alarm rules; publish and print the alarms."""
    from scan2sim.services.monitoring.events.alarm_node import AlarmsNode
    from scan2sim.services.monitoring.events.notify import message

    spin(lambda: AlarmsNode(params, lambda alarm: console.print(message(alarm), highlight=False, markup=False)))


@app.command("acknowledge")
@options(AcknowledgeParams, rule="RULE", subject="SUBJECT", kafka_bootstrap_servers="--kafka")
def monitor_acknowledge(params: AcknowledgeParams) -> None:
    """Acknowledge raised alarms: your name is published with them."""
    _send_command(params)


@app.command("mute")
@options(MuteParams, rule="RULE", subject="SUBJECT", seconds="--for", kafka_bootstrap_servers="--kafka")
def monitor_mute(params: MuteParams) -> None:
    """Mute alarms for some time: they are published, but not printed or sent by webhook and e-mail."""
    _send_command(params)


@app.command("retire")
@options(RetireParams, node="NODE", kafka_bootstrap_servers="--kafka")
def monitor_retire(params: RetireParams) -> None:
    """Clear all alarms of a node that is no longer in use, until it reports again."""
    _send_command(params)


def _send_command(params: AlarmCommandParams) -> None:
    from scan2sim.services.monitoring.events.alarm_commands import send

    send(params)
    console.print("sent to the alarm node", highlight=False, markup=False)


@app.command("page")
@options(PageParams, kafka_bootstrap_servers="--kafka")
def monitor_page(params: PageParams, limit: Limits = None) -> None:
    """Serve a live dashboard of the statistics, runs and alarms that arrive through Kafka."""
    optional_deps.require("the page", "fastapi", "uvicorn", "prometheus_client", "confluent_kafka")
    from scan2sim.services.monitoring.dashboard.app import serve

    serve(params, lambda text: console.print(text, highlight=False, markup=False))


@app.command("archive")
@options(ArchiveParams, kafka_bootstrap_servers="--kafka")
def monitor_archive(params: ArchiveParams) -> None:
    """Archive the statistics that arrive through Kafka, as hourly Parquet files."""
    optional_deps.require("the archive", "pyarrow", "confluent_kafka")
    from scan2sim.services.monitoring.export.archive import archive_records

    stop = threading.Event()
    with stop_on_signal(stop):
        archive_records(params, stop, warn)


@app.command("query")
@options(QueryParams)
def monitor_query(
    params: QueryParams,
    begin: Annotated[str | None, typer.Option("--from", help=QueryParams.model_fields["begin"].description)] = None,
    end: Annotated[str | None, typer.Option("--until", help=QueryParams.model_fields["end"].description)] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="CSV file to write; default: standard output.")
    ] = None,
) -> None:
    """Query an archive: messages, bandwidth, losses and latency by node, topic and interval, as CSV."""
    optional_deps.require("the archive", "pyarrow")
    from pyarrow import csv

    from scan2sim.services.monitoring.export.archive import query

    csv.write_csv(query(params), sys.stdout.buffer if out is None else out)
