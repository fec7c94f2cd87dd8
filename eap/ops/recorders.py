"""Starting and controlling recorders, which are processes of their own."""

from __future__ import annotations

import os
import select
import socket
import subprocess
import sys
from collections.abc import Iterable
from importlib.util import find_spec
from pathlib import Path

import msgspec

from eap.errors import ControlError, EnvironmentalError, ImageError
from eap.expressions import Condition
from eap.net.image_file import open_image
from eap.pd.image import Image
from eap.recording.capture import find_name
from eap.recording.process import STORE_VARIABLE, RecorderAnswer, RecorderRequest
from eap.recording.recorder import ENDINGS, RecorderOptions
from eap.recording.selection import check_patterns
from eap.recording.stores import check_url, shown_url
from eap.runtime.folder import ApplianceFolder, ApplianceInfo, describe_roots, find_running
from eap.runtime.recordings import RecordingFolder, RecordingState, find_recordings

START_S = 20.0
"""Time for a recorder to report that it records."""
ANSWER_S = 30.0
"""Time for an answer of a recorder: a file may have to be finished."""
_ROOT = str(Path(__file__).parents[2])
_NEEDED = ("mcap", "zstandard")


def start_recording(
    options: RecorderOptions, plant: str | None = None, target: Path | None = None
) -> RecordingState:
    """Start a recorder for the running plant that *options* fit, and return its state.

    Args:
        options: All but ``plant``, ``folder``, ``base`` and perhaps ``name``, which are filled in.
        plant: Name of the plant; needed when several that run fit.
        target: Path of the files; by default the name of the plant, in the present folder.

    Raises:
        ControlError: no plant fits, a pattern selects nothing, or the recorder cannot record.
        EnvironmentalError: files of that name exist, or a package is missing.
        ConfigError: the URL of ``to`` is that of no store.
    """
    _require_packages(options)
    folder, info = _find_plant(options.patterns, plant)
    _check_names(folder, info, options)
    ending = ENDINGS[options.kind]
    base = Path(os.path.abspath(target or info.plant))  # noqa: PTH100  resolve() follows links
    if base.suffix == ending:
        base = base.with_suffix("")
    if options.to:
        check_url(options.to)
    else:
        _check_target(base, ending)
    filled = msgspec.structs.replace(
        options,
        name=options.name or base.name,
        base=str(base),
        plant=info.plant,
        folder=str(folder.path),
    )
    return _spawn(filled)


def list_recordings(plant: str | None = None) -> list[RecordingState]:
    """Return the recordings of this user, of *plant* if given."""
    return [state for _, state in find_recordings() if plant in {None, state.plant}]


def stop_recording(name: str) -> RecordingState:
    """End the recording *name*; its files are whole then.  Raises as :func:`mark_recording`."""
    return _ask(name, RecorderRequest(do="stop"))


def mark_recording(name: str, text: str) -> RecordingState:
    """Write *text* into the recording *name*.

    Raises:
        ControlError: no such recording runs, or it does not answer.
    """
    return _ask(name, RecorderRequest(do="mark", text=text))


def snapshot_recording(name: str) -> RecordingState:
    """Write the ring of the recording *name* to a file, the last of ``files``.

    Raises:
        ControlError: no such recording runs, it has no ring, or nothing in it.
    """
    return _ask(name, RecorderRequest(do="snapshot"))


def running_names(*, stoppable: bool = False) -> list[str]:
    """Return the names of the recordings that run, with *stoppable* those of no plant file."""
    return [
        state.name
        for _, state in find_recordings()
        if not state.is_over and not (stoppable and state.is_of_plant)
    ]


def _require_packages(options: RecorderOptions) -> None:
    # pcapng needs no package; a ring of frames is compressed.
    needed = _NEEDED if options.kind == "values" else _NEEDED[1:] if options.ring_ns else ()
    missing = [name for name in needed if find_spec(name) is None]
    if missing:
        raise EnvironmentalError(
            f"recording needs {', '.join(missing)}, which is not installed: pip install"
            " 'eap-appliance[record]' (in the project's folder: pip install '.[record]')"
        )


def _find_plant(
    patterns: Iterable[str], plant: str | None
) -> tuple[ApplianceFolder, ApplianceInfo]:
    # A replay is found as well, but has no process images.
    running = [
        (folder, info)
        for folder, info in find_running()
        if plant in {None, info.plant} and folder.image(info.stations[0]).exists()
    ]
    if not running:
        which = f"no plant {plant!r} runs" if plant else "no plant runs"
        raise ControlError(
            f"{which} here (looked in {describe_roots()}): start one with eapctl run",
            code="unavailable",
        )
    stations = {each.partition("/")[0] for each in patterns}
    found = [each for each in running if not stations or stations & set(each[1].stations)]
    if len(found) > 1:
        names = ", ".join(info.plant for _, info in found)
        raise ControlError(f"several plants run ({names}): choose one with --plant")
    # Patterns with a * in the station fit any plant; what fits none is refused by its names.
    if not found and len(running) > 1:
        names = ", ".join(info.plant for _, info in running)
        raise ControlError(f"several plants run ({names}): choose one with --plant")
    return found[0] if found else running[0]


def _check_names(folder: ApplianceFolder, info: ApplianceInfo, options: RecorderOptions) -> None:
    images: dict[str, Image] = {}
    for station in info.stations:
        # Wrong names are found while a person waits, not in the log of a recorder.
        with open_image(folder.image(station)) as file:
            images[station] = file.image
    layouts = [image.layout for image in images.values()]
    if options.kind == "values":
        known = [f"{each.station}/{slot.name}" for each in layouts for slot in each.variables]
        known += [
            f"{each.station}/{name}"
            for each in layouts
            for name in (*(pd.name for pd in each.tx), *(pd.name for pd in each.rx))
        ]
        check_patterns(options.patterns, known, "variable")
    else:
        known = [f"{each.station}/{port.name}" for each in layouts for port in each.ports]
        check_patterns(options.patterns, known, "port")
    if options.when:
        for name in Condition(options.when).names:
            try:
                find_name(images, name)
            except ImageError as exc:
                raise ControlError(str(exc), code="unknown_name") from None


def _check_target(base: Path, ending: str) -> None:
    if not base.parent.is_dir():
        raise EnvironmentalError(f"{base.parent}: no such folder; make it, or choose another")
    if not os.access(base.parent, os.W_OK | os.X_OK):
        raise EnvironmentalError(f"{base.parent}: you may not write there; choose another folder")
    first = base.with_name(base.name + ending)
    if first.exists():
        raise EnvironmentalError(f"{first} exists: choose another name with -o, or remove it")


def _spawn(options: RecorderOptions) -> RecordingState:
    command = [sys.executable, "-m", "eap.recording.process"]
    paths = os.pathsep.join(filter(None, (_ROOT, _given_path())))
    environment = os.environ | {"PYTHONPATH": paths, STORE_VARIABLE: options.to}
    # Every user of the host can read command lines: the password goes by the environment.
    options = msgspec.structs.replace(options, to=shown_url(options.to))
    process = subprocess.Popen(  # noqa: S603  our own module
        [*command, msgspec.json.encode(options).decode()],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        # Away from the terminal: its Ctrl-C and its end are not meant for the recorder.
        start_new_session=True,
        # No folder is kept from being unmounted; a program that runs from its folder is found.
        cwd="/",
        env=environment,
    )
    assert process.stdout is not None  # noqa: S101  PIPE was given
    assert process.stderr is not None  # noqa: S101  PIPE was given
    with process.stdout, process.stderr:
        if not select.select([process.stdout], [], [], START_S)[0]:
            process.kill()
            process.wait()
            raise ControlError(f"recording {options.name!r} did not begin within {START_S:.0f} s")
        line = process.stdout.readline()
        if not line:
            process.wait()
            last = process.stderr.read().decode(errors="replace").strip().splitlines()
            reason = last[-1] if last else f"exit code {process.returncode}"
            raise ControlError(f"recording {options.name!r} did not begin: {reason}")
    answer = msgspec.json.decode(line, type=RecorderAnswer)
    if answer.error or answer.state is None:
        process.wait()
        raise ControlError(answer.error)
    # It lives on; this process must not warn that it was left alone.
    process.returncode = 0
    return answer.state


def _given_path() -> str:
    return os.environ.get("PYTHONPATH", "")


def _ask(name: str, request: RecorderRequest) -> RecordingState:
    folder = _running_folder(name)
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.settimeout(ANSWER_S)
        try:
            connection.connect(str(folder.control_socket))
            connection.sendall(msgspec.json.encode(request) + b"\n")
            with connection.makefile("rb") as reader:
                line = reader.readline()
        except OSError as exc:
            raise ControlError(
                f"recording {name!r} does not answer: {exc}", code="unavailable"
            ) from None
    if not line:
        raise ControlError(f"recording {name!r} ended meanwhile", code="unavailable")
    answer = msgspec.json.decode(line, type=RecorderAnswer)
    if answer.error or answer.state is None:
        raise ControlError(answer.error)
    return answer.state


def _running_folder(name: str) -> RecordingFolder:
    found = find_recordings()
    for folder, state in found:
        if state.name == name and not state.is_over:
            return folder
    running = ", ".join(state.name for _, state in found if not state.is_over) or "none"
    raise ControlError(f"no recording {name!r} runs; running: {running}", code="unknown_name")


def only_recording(names: Iterable[str]) -> str:
    """Return the one of *names*, those of running recordings, if there is one.

    Raises:
        ControlError: there is none, or there are several.
    """
    found = list(names)
    if len(found) == 1:
        return found[0]
    if not found:
        raise ControlError("no recording runs: start one with 'eapctl record start'")
    raise ControlError(f"several recordings run ({', '.join(found)}): name one")
