"""A Slurm cluster of this machine alone: a controller, a node and their key, in a folder, on ports of their own."""

from __future__ import annotations

import getpass
import os
import secrets
import shutil
import signal
import socket
import subprocess
import time
from contextlib import suppress
from pathlib import Path

NEEDED = ("munged", "slurmctld", "slurmd", "sbatch", "srun", "scancel", "scontrol", "squeue")
DAEMONS = ("slurmd", "slurmctld", "munged")  # in the order in which they are stopped
SYSTEM = os.pathsep.join(["/usr/sbin", "/usr/local/sbin", "/sbin"])  # of daemons; not on every user's PATH
CONFIGURATION = """\
ClusterName=usvlearn
SlurmctldHost=localhost(127.0.0.1)
SlurmctldPort={ports[0]}
SlurmdPort={ports[1]}
SlurmUser={user}
SlurmdUser={user}
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket,cred_expire=5
CredType=cred/munge
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SwitchType=switch/none
MpiDefault=none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
SchedulerParameters=batch_sched_delay=1,sched_interval=2
ReturnToService=2
JobRequeue=0
KillWait=2
NodeName=localhost NodeAddr=127.0.0.1 Port={ports[1]} CPUs=2 RealMemory=2100
PartitionName=main Nodes=localhost Default=YES
PartitionName=night Nodes=localhost
"""


class Unavailable(Exception):
    """Slurm is not installed here, or does not start."""


class Slurm:
    """A cluster that runs from `start` to `stop`; nothing of it is outside its folder."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.environment = {
            **{key: value for key, value in os.environ.items() if not key.startswith(("SLURM_", "SBATCH_", "SQUEUE_"))},
            "SLURM_CONF": str(folder / "slurm.conf"),
            "PATH": os.pathsep.join([os.environ.get("PATH", os.defpath), SYSTEM]),
        }

    def start(self) -> None:
        """Start the daemons and wait until the node is idle."""
        missing = [name for name in NEEDED if shutil.which(name, path=self.environment["PATH"]) is None]
        if missing:
            raise Unavailable(f"found no {', '.join(missing)}: apt-get install slurm-wlm munge")
        for name in ("state", "spool"):
            (self.folder / name).mkdir(mode=0o755)
        values = {"folder": self.folder, "ports": _free_ports(2), "user": getpass.getuser()}
        (self.folder / "slurm.conf").write_text(CONFIGURATION.format(**values))
        key = self.folder / "munge.key"
        key.touch(mode=0o600)
        key.write_bytes(secrets.token_bytes(128))
        places = {"key-file": "munge.key", "socket": "munge.socket", "pid-file": "munged.pid",
                  "log-file": "munged.log", "seed-file": "munge.seed"}  # fmt: skip
        options = [f"--{name}={self.folder / place}" for name, place in places.items()]
        try:
            self.call("munged", "--force", "--num-threads=2", *options)
            self.call("slurmctld")
            self.call("slurmd", "-N", "localhost")
            self.wait(lambda: "idle" in self.call("sinfo", "--noheader", "--format=%T"), "the node is not idle", 20)
        except (OSError, subprocess.SubprocessError, AssertionError) as error:
            said = getattr(error, "stderr", None) or error
            self.stop()
            raise Unavailable(f"Slurm does not start here: {said}") from error

    def end_jobs(self) -> None:
        """End all jobs."""
        self.call("scancel", "--user", getpass.getuser())
        self.wait(lambda: not self.jobs(), "jobs do not end", 20)

    def stop(self) -> None:
        """End the jobs, and each daemon by its own number."""
        with suppress(OSError, subprocess.SubprocessError, AssertionError):
            self.end_jobs()
        for name in DAEMONS:
            with suppress(OSError, ValueError):
                number = int((self.folder / f"{name}.pid").read_text())
                os.kill(number, signal.SIGTERM)
                if not _ended(number, 10):
                    os.kill(number, signal.SIGKILL)

    def call(self, *command: str) -> str:
        """The output of a command of Slurm."""
        program = shutil.which(command[0], path=self.environment["PATH"]) or command[0]
        done = subprocess.run([program, *command[1:]], env=self.environment, check=True, timeout=30,
                              stdin=subprocess.DEVNULL, capture_output=True, text=True)  # fmt: skip
        return done.stdout.strip()

    def job(self, number: str) -> dict[str, str]:
        """What `scontrol show job` says of a job, by key."""
        fields = self.call("scontrol", "show", "job", "--oneliner", number).split()
        return dict(field.split("=", 1) for field in fields if "=" in field)

    def jobs(self) -> list[str]:
        """The numbers of all jobs that have not ended, `12_0` in an array."""
        return self.call("squeue", "--noheader", "--array", "--format=%i").split()

    @staticmethod
    def wait(reached, otherwise: str, seconds: float = 60) -> None:
        """Wait until a condition is reached; an AssertionError says what was not."""
        end = time.monotonic() + seconds
        while not reached():
            assert time.monotonic() < end, f"{otherwise} after {seconds} s"
            time.sleep(0.1)


def _free_ports(count: int) -> list[int]:
    sockets = [socket.create_server(("127.0.0.1", 0)) for _ in range(count)]
    ports = [each.getsockname()[1] for each in sockets]
    for each in sockets:
        each.close()
    return ports


def _ended(number: int, seconds: float) -> bool:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        try:
            os.kill(number, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.05)
    return False
