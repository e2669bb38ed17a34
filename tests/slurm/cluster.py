"""A Slurm cluster on this machine: munged, slurmctld and one slurmd per node, in one folder and on free ports, for tests.

`python -m tests.slurm.cluster FOLDER` starts one of two nodes, prints its SLURM_CONF and runs until Ctrl-C. Debian's packages are enough
(`tests/slurm/install.sh`); root is needed, because slurmd starts jobs as their owner. Nodes share this machine's files, as nodes of a
farm share a network folder. Each has a mount namespace of its own, in which /etc/slurm is the cluster's configuration (the machine's is
left alone), and in which folders can be on a full disk.
"""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import psutil

PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "squeue", "scontrol", "scancel", "sinfo")
_CONFIG_FOLDER = Path("/etc/slurm")
#: Variable by which the processes of a node's slurmd are found.
_MARK = "GSBAKE_TEST_NODE"
#: Seconds until a node that does not answer counts as lost, and until the daemons must be ready.
NODE_TIMEOUT, START_TIMEOUT = 60, 300.0
_CONFIG = """\
ClusterName=gsbake
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={port}
AuthType=auth/munge
AuthInfo=socket={folder}/munge/socket
CredType=cred/munge
SlurmUser=root
SlurmdUser=root
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool/%n
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd-%n.pid
SlurmctldLogFile={folder}/log/slurmctld.log
SlurmdLogFile={folder}/log/slurmd-%n.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
MpiDefault=none
SwitchType=switch/none
ReturnToService=2
SlurmdTimeout={node_timeout}
KillWait=30
OverTimeLimit=UNLIMITED
SchedulerParameters=sched_interval=5,bf_interval=5,batch_sched_delay=0,sched_min_interval=0
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
SlurmdParameters=config_overrides
PreemptType=preempt/partition_prio
PreemptMode=REQUEUE
{nodes}
PartitionName=farm Nodes=ALL Default=YES PriorityTier=1 GraceTime=60 MaxTime=INFINITE State=UP
PartitionName=urgent Nodes=ALL PriorityTier=9 PreemptMode=OFF MaxTime=INFINITE State=UP
"""


class SlurmUnavailable(Exception):
    """Slurm cannot be started on this machine; the message says why."""


class Cluster:
    """A cluster in `folder`; a context manager that starts and stops it. `cpus` and `memory_mb` are those of each node."""

    def __init__(self, folder: Path, nodes: Sequence[str] = ("node1", "node2"), cpus: int = 1, memory_mb: int = 8000) -> None:
        self.folder, self.nodes, self.cpus, self.memory_mb = folder.resolve(), tuple(nodes), cpus, memory_mb
        self.config = self.folder / "etc" / "slurm.conf"
        self._daemons: dict[str, subprocess.Popen[bytes]] = {}

    @property
    def environment(self) -> dict[str, str]:
        """This process's environment, with which Slurm's commands talk to the cluster."""
        return {**os.environ, "SLURM_CONF": str(self.config)}

    def __enter__(self) -> Cluster:
        try:
            self.start()
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(self) -> None:
        """Start all daemons and wait until the nodes are idle. Raises SlurmUnavailable."""
        missing = [name for name in PROGRAMS if shutil.which(name) is None]
        if missing:
            raise SlurmUnavailable(f"{', '.join(missing)} not found; run tests/slurm/install.sh as root")
        if os.geteuid() != 0:
            raise SlurmUnavailable("slurmd needs root")
        if not _CONFIG_FOLDER.is_dir() or subprocess.run(["unshare", "--mount", "true"], capture_output=True, check=False).returncode:
            raise SlurmUnavailable(f"mount namespaces, or the folder {_CONFIG_FOLDER}, are missing")
        for name in ("etc", "munge", "state", "spool", "log"):
            (self.folder / name).mkdir(parents=True, exist_ok=True)
        self.folder.chmod(0o755)
        (self.folder / "munge").chmod(0o755)
        key = self.folder / "munge" / "key"
        key.write_bytes(os.urandom(1024))
        key.chmod(0o400)
        self.config.write_text(self._configuration())
        munge = self.folder / "munge"
        self._start(
            "munged", "munged", "--foreground", "--force", f"--key-file={key}", f"--socket={munge}/socket", f"--pid-file={munge}/pid",
            f"--log-file={munge}/log", f"--seed-file={munge}/seed",
        )  # fmt: skip
        self._wait(lambda: (munge / "socket").exists(), "munged does not start")
        self.start_controller()
        for node in self.nodes:
            self.start_node(node)
        self._wait(lambda: set(self.node_states().values()) == {"idle"}, "the nodes do not become idle")

    def stop(self) -> None:
        """Stop all daemons and kill what runs on the nodes."""
        for node in self.nodes:
            self.kill_node(node)
        for process in reversed(self._daemons.values()):
            process.terminate()
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self._daemons.clear()

    def start_node(self, node: str, full: Sequence[Path] = ()) -> None:
        """Start the slurmd of a node, which sees the folders `full` empty and on a disk without any free space."""
        lines = [f"mount --bind {shlex.quote(str(self.config.parent))} {_CONFIG_FOLDER}"]
        for path in full:
            path.mkdir(parents=True, exist_ok=True)
            disk = shlex.quote(str(path))
            lines.append(f"mount -t tmpfs -o size=64k full {disk}; cat /dev/zero > {disk}/filler 2>/dev/null || true")
        lines.append("exec " + shlex.join(["slurmd", "-D", "-N", node, "-f", str(self.config)]))
        self._start(node, "unshare", "--mount", "sh", "-e", "-c", "\n".join(lines), mark=node)

    def kill_node(self, node: str) -> None:
        """Kill everything that runs on a node at once, as a power failure does: slurmd and its steps first, so that none reports an end."""
        for process in self._processes(node):
            with suppress(psutil.NoSuchProcess):
                process.kill()
        daemon = self._daemons.pop(node, None)
        if daemon is not None:
            daemon.wait()

    def start_controller(self) -> None:
        """Start slurmctld, which reads the state that an earlier one saved."""
        self._start("slurmctld", "slurmctld", "-D", "-f", str(self.config))

    def kill_controller(self) -> None:
        """Kill slurmctld; the jobs go on."""
        daemon = self._daemons.pop("slurmctld")
        daemon.kill()
        daemon.wait()

    def call(self, *command: str) -> str:
        """Output of one of Slurm's commands."""
        return subprocess.run(command, env=self.environment, capture_output=True, text=True, check=True, timeout=60).stdout

    def node_states(self) -> dict[str, str]:
        """{node: state}, such as idle, mixed, allocated, down; empty while slurmctld does not answer."""
        with suppress(subprocess.SubprocessError):
            rows = self.call("sinfo", "--noheader", "--Node", "--partition=farm", "--format=%N %T").splitlines()
            return dict(row.split() for row in rows)
        return {}

    def jobs(self) -> list[tuple[str, str, str, int]]:
        """(identifier, state, node, restarts) of the jobs that run or wait."""
        rows = (line.split("|") for line in self.call("squeue", "--noheader", "--format=%A|%T|%N|%r").splitlines())
        return [(row[0], row[1], row[2], self._restarts(row[0])) for row in rows]

    def running_on(self, node: str) -> list[str]:
        """Identifiers of the jobs that run on a node."""
        return self.call("squeue", "--noheader", "--states=RUNNING", f"--nodelist={node}", "--format=%A").split()

    def _restarts(self, job: str) -> int:
        with suppress(subprocess.SubprocessError, StopIteration):
            words = self.call("scontrol", "--oneliner", "show", "job", job).split()
            return int(next(word for word in words if word.startswith("Restarts=")).partition("=")[2])
        return 0

    def _processes(self, node: str) -> list[psutil.Process]:
        """slurmd and its steps (by this test's mark), then the jobs' processes (by Slurm's variables)."""
        daemons, jobs = [], []
        for process in psutil.process_iter():
            with suppress(psutil.Error):
                environment = process.environ()
                if environment.get(_MARK) == f"{self.folder}:{node}":
                    daemons.append(process)
                elif environment.get("SLURM_CONF") == str(self.config) and environment.get("SLURMD_NODENAME") == node:
                    jobs.append(process)
        return daemons + jobs

    def _start(self, name: str, *command: str, mark: str | None = None) -> None:
        environment = dict(self.environment)
        if mark is not None:
            environment[_MARK] = f"{self.folder}:{mark}"
        with (self.folder / "log" / f"{name}.out").open("ab") as log:
            self._daemons[name] = subprocess.Popen(
                command, env=environment, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True
            )

    def _wait(self, ready: object, complaint: str) -> None:
        assert callable(ready)
        deadline = time.monotonic() + START_TIMEOUT
        while not ready():
            ended = [name for name, process in self._daemons.items() if process.poll() is not None]
            if ended or time.monotonic() > deadline:
                logs = "".join(path.read_text(errors="replace")[-600:] for path in sorted((self.folder / "log").glob("*")))
                raise SlurmUnavailable(f"{complaint}{f' ({ended[0]} ended)' if ended else ''}: {logs[-1500:]}")
            time.sleep(0.2)

    def _configuration(self) -> str:
        host = socket.gethostname()
        ports = _free_ports(1 + len(self.nodes))
        nodes = "\n".join(
            f"NodeName={node} NodeHostname={host} NodeAddr=127.0.0.1 Port={port} CPUs={self.cpus} RealMemory={self.memory_mb}"
            for node, port in zip(self.nodes, ports[1:], strict=True)
        )
        return _CONFIG.format(host=host, port=ports[0], folder=self.folder, node_timeout=NODE_TIMEOUT, nodes=nodes)


def _free_ports(count: int) -> list[int]:
    sockets = [socket.socket() for _ in range(count)]
    try:
        for entry in sockets:
            entry.bind(("127.0.0.1", 0))
        return [int(entry.getsockname()[1]) for entry in sockets]
    finally:
        for entry in sockets:
            entry.close()


def main() -> None:
    """Start a cluster in the folder given, and stop it at Ctrl-C."""
    with Cluster(Path(sys.argv[1])) as cluster:
        sys.stdout.write(f"export SLURM_CONF={shlex.quote(str(cluster.config))}\n")
        sys.stdout.flush()
        with suppress(KeyboardInterrupt):
            signal.pause()


if __name__ == "__main__":
    main()
