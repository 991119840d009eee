"""Nodes as child processes on a ROS domain of their own, ended and reaped whatever happens."""

from __future__ import annotations

import ctypes
import os
import random
import re
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType

from railtrack_ros.paths import config_directory

# A DDS domain d uses the UDP ports 7400 + 250 d to 7649 + 250 d; above 101 they run into the
# ports that Linux hands out for outgoing connections.
FIRST_PORT, PORTS_PER_DOMAIN, LAST_DOMAIN = 7400, 250, 101
FIRST_PARTICIPANT, LAST_PORT = 10, 249

# Time that a process has to end after SIGINT, then after SIGTERM, before it is killed, s.
PATIENCE = 5.0

# Files of settings for Fast DDS, by the names of its versions 2 and 3.
TRANSPORT_VARIABLES = ('FASTRTPS_DEFAULT_PROFILES_FILE', 'FASTDDS_DEFAULT_PROFILES_FILE')

LOG_LINE = re.compile(r'^\[(?P<severity>\w+)\] \[(?P<name>[^]]+)\]: (?P<text>.*)$')


class Domain:
    """A ROS domain that no other program on this machine uses, kept until closed.

    The domain is claimed by holding the last of its ports, which makes the choice safe among
    programs that start at the same moment; a domain where the port of the first DDS
    participant is taken belongs to somebody else's ROS system.
    """

    def __init__(self) -> None:
        candidates = list(range(1, LAST_DOMAIN + 1))
        random.shuffle(candidates)
        for self.number in candidates:
            base = FIRST_PORT + PORTS_PER_DOMAIN * self.number
            try:
                with _udp_port(base + FIRST_PARTICIPANT):
                    self._claim = _udp_port(base + LAST_PORT)
                return
            except OSError:
                continue
        raise RuntimeError(f'all ROS domains up to {LAST_DOMAIN} of this machine are in use')

    def environment(self, log_directory: Path) -> dict[str, str]:
        """Return the variables that keep a ROS process in this domain and on this machine."""
        return {
            'ROS_DOMAIN_ID': str(self.number),
            'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
            'ROS_STATIC_PEERS': '',
            'ROS_LOG_DIR': str(log_directory),
            'RCUTILS_CONSOLE_OUTPUT_FORMAT': '[{severity}] [{name}]: {message}',
        }

    def close(self) -> None:
        """Give the domain back."""
        self._claim.close()


def _udp_port(number: int) -> socket.socket:
    port = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        port.bind(('127.0.0.1', number))
    except OSError:
        port.close()
        raise
    return port


class Process:
    """One running module of this package; its output goes to a file and to a listener."""

    def __init__(
        self,
        name: str,
        command: Sequence[str],
        environment: Mapping[str, str],
        log_file: Path,
        listen: Callable[[str, str], None],
    ) -> None:
        self.name = name
        self.log_file = log_file
        self._listen = listen
        self._child = subprocess.Popen(
            list(command),
            env={**os.environ, **environment},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors='replace',
            bufsize=1,
            # Ctrl-C on the terminal goes to the program that started us; it passes it on.
            start_new_session=True,
            preexec_fn=_end_with_parent if sys.platform == 'linux' else None,
        )
        self._reader = threading.Thread(target=self._read, name=f'{name} output')
        self._reader.start()

    @property
    def status(self) -> int | None:
        """Exit status, None while it runs."""
        return self._child.poll()

    @property
    def pid(self) -> int:
        """Process id."""
        return self._child.pid

    def processor_time(self) -> float | None:
        """Return the seconds on a processor so far; None where the system does not tell."""
        try:
            fields = Path(f'/proc/{self._child.pid}/stat').read_text().rsplit(')', 1)[1].split()
        except OSError:
            return None
        return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')

    def stop(self) -> int:
        """Ask it to end, insist if need be, and return its exit status."""
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
            if self._child.poll() is None:
                self._child.send_signal(number)
            try:
                self._child.wait(PATIENCE)
                break
            except subprocess.TimeoutExpired:
                continue
        status = self._child.wait()
        self._reader.join()
        return status

    def tail(self, lines: int = 5) -> str:
        """Return the last lines of its output, for an error message."""
        return '\n'.join(self.log_file.read_text(errors='replace').splitlines()[-lines:])

    def _read(self) -> None:
        assert self._child.stdout is not None
        with self.log_file.open('w') as log, self._child.stdout as lines:
            for line in lines:
                log.write(line)
                log.flush()
                match = LOG_LINE.match(line.rstrip())
                if match:
                    self._listen(match['severity'], match['text'])


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Put SIGINT and SIGTERM off until the end of the block.

    Between the start of a process and the note of it, one would leave it behind.
    """
    came: list[int] = []
    before = {
        number: signal.signal(number, lambda number, frame: came.append(number))
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if came:
        signal.raise_signal(came[0])


class Processes:
    """The child processes of a program; leaving the context ends all of them.

    Parameters
    ----------
    environment
        Variables added to those of this process.
    log_directory
        Folder for NAME.log, the output of each process.
    """

    def __init__(self, environment: Mapping[str, str], log_directory: Path) -> None:
        self._environment = environment
        self._log_directory = log_directory
        self._running: list[Process] = []

    def __enter__(self) -> Processes:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        with uninterrupted():
            for process in self._running:
                process.stop()

    def start(
        self,
        name: str,
        module: str,
        arguments: Sequence[str] = (),
        listen: Callable[[str, str], None] = lambda severity, text: None,
    ) -> Process:
        """Start `python -m module arguments`; `listen` gets severity and text of its log lines.

        `listen` is called from a thread of the process's own.
        """
        command = [sys.executable, '-m', module, *arguments]
        log_file = self._log_directory / f'{name}.log'
        with uninterrupted():
            process = Process(name, command, self._environment, log_file, listen)
            self._running.append(process)
        return process


def ros_parameters(values: Mapping[str, object]) -> list[str]:
    """Return the command line arguments that set ROS parameters.

    Strings are quoted, since rcl reads the values as YAML.
    """
    arguments = ['--ros-args']
    for name, value in values.items():
        arguments += ['-p', f'{name}:={_as_yaml(value)}']
    return arguments


def _as_yaml(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (str, Path)):
        return "'" + str(value).replace("'", "''") + "'"
    if isinstance(value, (list, tuple)):
        return '[' + ', '.join(_as_yaml(item) for item in value) + ']'
    return repr(value)


def resident_memory(pid: int | str = 'self') -> int:
    """Return the memory of a process in bytes, 0 where the system does not tell."""
    try:
        pages = int(Path(f'/proc/{pid}/statm').read_text().split()[1])
    except (OSError, ValueError, IndexError):
        return 0
    return pages * os.sysconf('SC_PAGE_SIZE')


def transport() -> dict[str, str]:
    """Return the variables that give Fast DDS room for waveforms, unless the user has his own."""
    if any(name in os.environ for name in TRANSPORT_VARIABLES):
        return {}
    return {TRANSPORT_VARIABLES[0]: str(config_directory() / 'fastdds.xml')}


def _end_with_parent() -> None:
    """Have the kernel send SIGTERM to this process when the one that started it dies."""
    ctypes.CDLL(None).prctl(1, signal.SIGTERM)  # 1: PR_SET_PDEATHSIG

