"""Appliances forked from a Python that has imported them: a quarter of the time of a start.

Most of a start is the import of some hundred modules, in each process anew.  Here a *fork server*
has done that once for all tests of a worker::

    worker ── fork server          it forks supervisors, as children of the worker
       └───── supervisor
                 ├── fork server   of its own, forked before anything else; it forks the processes
                 └── engine        of the appliance, as children of the supervisor

Signals, ends, descriptors, groups, limits, umask, network and environment are as of processes that
start by themselves.  Two things differ: the command lines are those of the fork server, and memory
has what any of the processes imports.  Programs start instead with *is_real*, with a prefix that
does more than to enter a namespace, with other settings of Python, in an appliance of which a
process has ended, and everywhere with EAP_TEST_REAL=1.

Run as a module, this is the fork server of a worker.
"""

from __future__ import annotations

import atexit
import ctypes
import fcntl
import gc
import json
import os
import platform
import re
import resource
import signal
import socket
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from tests.support.namespaces import become_inside, enter_network

_INSIDE = ("ip", "netns", "exec")
_ROOT = Path(__file__).parents[2]
_CLONE = {"x86_64": 56, "aarch64": 220}.get(platform.machine())
_CLONE_PARENT = 0x8000
_LIMITS = (resource.RLIMIT_NOFILE, resource.RLIMIT_FSIZE, resource.RLIMIT_AS, resource.RLIMIT_CORE)
_ANSWER_S = 240.0
_MAX_REQUEST = 1 << 20
_MAX_DESCRIPTORS = 200
_ABOVE = 600
"""Descriptors from here on are free while those of a request get their numbers."""


def _settings() -> dict[str, str]:
    """Return the environment of Python itself, which has an effect at its start alone."""
    return {name: value for name, value in os.environ.items() if name.startswith("PYTHON")}


_SETTINGS = _settings()


def _umask() -> int:
    """Return the umask of this process, which os.umask() tells only by changing it."""
    (digits,) = re.findall(r"^Umask:\s*(\d+)", Path("/proc/self/status").read_text(), re.MULTILINE)
    return int(digits, 8)


def is_possible(prefix: Sequence[str]) -> bool:
    """Tell whether appliances that *prefix* starts may come from a fork server here and now."""
    is_plain = not prefix or (tuple(prefix[:3]) == _INSIDE and len(prefix) == 4)
    is_allowed = not os.environ.get("EAP_TEST_REAL") and _settings() == _SETTINGS
    return is_plain and is_allowed and _CLONE is not None


class _Forked(subprocess.Popen[Any]):
    """Process that a fork server forks; all else is as of one that is started.

    Args:
        server: Connection to it.
        command: Its command line.
    """

    def __init__(self, server: socket.socket, command: Sequence[str], **options: Any) -> None:
        self._server = server
        super().__init__(command, **options)

    def _execute_child(  # type: ignore[misc]
        self, args: Sequence[str], *more: Any
    ) -> None:
        executable, prepare, _, pass_fds, cwd, env, _, _, shell, *pipes = more[:15]
        if executable or prepare or shell or more[16:21] != (None, None, None, -1, False):
            raise ValueError("a forked process takes no program, function, shell, user or session")
        own = pipes[0], pipes[3], pipes[5]
        standard = [given if given >= 0 else number for number, given in enumerate(own)]
        request = {
            "command": list(args),
            "environment": dict(os.environ if env is None else env),
            "folder": str(cwd or Path.cwd()),
            "group": more[-1],
            "limits": [(each, *resource.getrlimit(each)) for each in _LIMITS],
            "numbers": [0, 1, 2, *pass_fds],
            "umask": _umask(),
        }
        network = os.open("/proc/thread-self/ns/net", os.O_RDONLY)
        try:
            self.pid = _ask(self._server, request, [network, *standard, *pass_fds])
            self._child_created = True
        finally:
            os.close(network)
            self._close_pipe_fds(*pipes)  # type: ignore[attr-defined]


def _ask(server: socket.socket, request: dict[str, Any], descriptors: Sequence[int]) -> int:
    """Return the id of the process that *server* forks."""
    data = json.dumps(request).encode()
    socket.send_fds(server, [len(data).to_bytes(4, "little")], descriptors)
    server.sendall(data)
    answer = server.recv(4)
    if len(answer) < 4:
        raise OSError("the fork server of the tests has ended")
    return int.from_bytes(answer, "little")


@cache
def _fork_server() -> socket.socket:
    """Start the fork server of this worker, and return the connection to it."""
    own, its = socket.socketpair()
    own.settimeout(_ANSWER_S)
    with its:
        process = subprocess.Popen(
            [sys.executable, "-m", __name__, str(its.fileno())],
            pass_fds=(its.fileno(),), cwd=_ROOT, stdin=subprocess.DEVNULL,
        )  # fmt: skip
    atexit.register(process.wait)
    atexit.register(own.close)
    return own


def start(command: Sequence[str], **options: Any) -> subprocess.Popen[Any]:
    """Start ``python -m eap``, maybe in a namespace, as :class:`subprocess.Popen` does."""
    return _Forked(_fork_server(), command, **options)


def _clone_for_parent() -> int:
    """Fork; the new process is a child of the parent of this one."""
    assert _CLONE is not None
    api, library = ctypes.pythonapi, ctypes.PyDLL(None, use_errno=True)
    api.PyOS_BeforeFork()
    pid = int(library.syscall(_CLONE, _CLONE_PARENT | signal.SIGCHLD, 0, 0, 0, 0))
    if pid:
        api.PyOS_AfterFork_Parent()
    else:
        api.PyOS_AfterFork_Child()
    if pid < 0:
        raise OSError(ctypes.get_errno(), "clone")
    return pid


def _serve(connection: socket.socket, run: Callable[[list[str]], int | None]) -> None:
    """Fork what is asked for until the other end is closed; *run* is the program of a child."""
    while True:
        head, descriptors, _, _ = socket.recv_fds(connection, 4, _MAX_DESCRIPTORS)
        if len(head) < 4:
            os._exit(0)
        size, data = int.from_bytes(head, "little"), b""
        while len(data) < size:
            data += connection.recv(size - len(data))
        pid = _clone_for_parent()
        if not pid:
            connection.close()
            _run_request(json.loads(data), descriptors, run)
        for each in descriptors:
            os.close(each)
        connection.sendall(pid.to_bytes(4, "little"))


def _run_request(
    request: dict[str, Any], descriptors: list[int], run: Callable[[list[str]], int | None]
) -> None:
    """Make this process the one of *request*, run it, and end it."""
    code: Any = 1
    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        for number, *limits in request["limits"]:
            resource.setrlimit(number, limits)
        os.umask(request["umask"])
        network, *descriptors = descriptors
        if not os.path.samestat(os.fstat(network), Path("/proc/thread-self/ns/net").stat()):
            enter_network(network)
        if request["group"] >= 0:
            signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # as the supervisor has it
            os.setpgid(0, request["group"])
        moved = [fcntl.fcntl(each, fcntl.F_DUPFD_CLOEXEC, _ABOVE) for each in descriptors]
        os.closerange(3, _ABOVE)
        for number, each in zip(request["numbers"], moved, strict=True):
            os.dup2(each, number)
        for each in moved:
            os.close(each)
        os.environ.clear()
        os.environ.update(request["environment"])
        os.chdir(request["folder"])
        code = run(request["command"])
    except SystemExit as exc:
        code = exc.code
    except BaseException:  # noqa: BLE001  as Python does at the end
        traceback.print_exc()
    if isinstance(code, str):
        print(code, file=sys.stderr)
    try:
        threading._shutdown()  # type: ignore[attr-defined]
        atexit._run_exitfuncs()
        sys.stdout.flush()
        sys.stderr.flush()
    finally:
        os._exit(code if isinstance(code, int) else int(code is not None))


def _run_eapctl(command: list[str]) -> int | None:
    """Run ``python -m eap WORDS``, whose processes come from a fork server of its own."""
    import eap.supervisor.child as module
    from eap.__main__ import main

    if tuple(command[:3]) == _INSIDE:
        become_inside(command[3])
        command = command[4:]
    own, its = socket.socketpair()
    if os.fork() == 0:
        own.close()
        os.setpgid(0, 0)
        for number in range(3):
            os.dup2(os.open(os.devnull, os.O_RDWR), number)
        os.dup2(its.detach(), 3)
        os.closerange(4, _ABOVE)
        its = socket.socket(fileno=3)
        _serve(its, _run_process)
    its.close()
    made: list[subprocess.Popen[Any]] = []

    def start_child(words: Sequence[str], **options: Any) -> subprocess.Popen[Any]:
        # A test that kills a process looks at the start of the next one, so this is a program.
        if any(each.returncode is not None for each in made):
            return subprocess.Popen(words, **options)
        made.append(_Forked(own, words, **options))
        return made[-1]

    module.subprocess = SimpleNamespace(  # type: ignore[assignment]
        Popen=start_child, DEVNULL=subprocess.DEVNULL
    )
    sys.argv = ["eapctl", *command[3:]]
    main()
    return None


def _run_process(command: list[str]) -> int | None:
    """Run ``python -m eap.runtime.startup WORDS``."""
    from eap.runtime.startup import main

    return main(command[3:])


def _run_fork_server(descriptor: int) -> None:
    """Import all that appliances import, and fork them as they are requested."""
    gc.disable()
    import eap.cli.plant
    import eap.engine.process
    import eap.segment.process
    import eap.services.process
    import eap.supervisor.process  # noqa: F401

    gc.collect()
    gc.freeze()
    gc.enable()
    _serve(socket.socket(fileno=descriptor), _run_eapctl)


if __name__ == "__main__":
    _run_fork_server(int(sys.argv[1]))
