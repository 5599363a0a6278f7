"""Operating systems, where they differ: locks, limits, signals, the start of processes, figures
of memory, and the console.

Only this module asks what the system offers. Linux has all of it; each function says what it does
elsewhere. It is run on Linux only, also without these modules and functions and with a stand-in for
Windows' locks (`tests/support/bare`)."""

import errno
import faulthandler
import gc
import importlib
import io
import os
import select
import shutil
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import pairwise
from pathlib import Path
from typing import IO, Any, Literal

PROC = Path("/proc")


def _module(name: str) -> Any:
    """Return a module of the standard library, or None on systems without it."""
    try:
        return importlib.import_module(name)
    except ImportError:
        return None


# ---------------------------------------------------------------- locks

Answer = Literal["held", "busy", "no locks"]
"""``busy``: held by another process. ``no locks``: of some file systems."""
SHARERS = 64
"""Bytes of a lock file on Windows, whose Python locks bytes for one process only: a shared lock
takes a free byte, an exclusive lock all of them, as SQLite does."""
WINDOWS_BYTES = 1 << 30
"""Windows' Python counts positions in 32 bits."""
WAITS_S = 0.05


def lock(file: IO[bytes], *, shared: bool, wait: bool) -> Answer:
    """Lock an open file until it is closed; return whether the lock is held."""
    fcntl = _module("fcntl")
    if fcntl is not None:
        try:
            how = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
            fcntl.flock(file, how if wait else how | fcntl.LOCK_NB)
        except BlockingIOError:
            return "busy"
        except OSError:
            return "no locks"
        return "held"
    msvcrt = _module("msvcrt")
    if msvcrt is None:
        return "no locks"
    places = [(start, 1) for start in range(SHARERS)] if shared else [(0, SHARERS)]
    while not any(_lock_bytes(msvcrt, file, start, count) for start, count in places):
        if not wait:
            return "busy"
        time.sleep(WAITS_S)
    return "held"


@contextmanager
def locked_byte(file: IO[bytes], number: int) -> Iterator[None]:
    """Lock byte ``number`` of an open file against other processes, and wait for it; where there
    are no locks, go on without."""
    fcntl = _module("fcntl")
    if fcntl is not None:
        with suppress(OSError):  # a file system without locks
            fcntl.lockf(file, fcntl.LOCK_EX, 1, number)
        yield
        return
    msvcrt = _module("msvcrt")
    if msvcrt is not None:
        while not _lock_bytes(msvcrt, file, number % WINDOWS_BYTES, 1):
            time.sleep(WAITS_S)
    yield


def _lock_bytes(msvcrt: Any, file: IO[bytes], start: int, count: int) -> bool:
    """Return whether bytes of a file could be locked on Windows."""
    file.seek(start)
    try:
        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, count)
    except OSError:
        return False
    return True


# ---------------------------------------------------------------- limits and figures of memory

_LOCK = threading.Lock()
_WANTED = list[int]()
_BEFORE = list[tuple[int, int]]()
"""The limits that active `limited_memory` contexts request, and the process's own limit before the
first of them."""


@contextmanager
def limited_memory(most_bytes: int) -> Iterator[None]:
    """Limit the additional memory of the process; an excess raises MemoryError. The limit
    (RLIMIT_AS) holds for all threads; the lowest of several counts. Only Linux has it."""
    resource = _module("resource")
    try:
        pages = int((PROC / "self/statm").read_text(encoding="ascii").split()[0])
    except OSError:
        resource = None
    if resource is None:
        yield
        return
    wanted = pages * resource.getpagesize() + most_bytes

    def set_least() -> None:
        soft, hard = _BEFORE[0]
        limits = [limit for limit in (*_WANTED, soft, hard) if limit != resource.RLIM_INFINITY]
        resource.setrlimit(resource.RLIMIT_AS, (min(limits, default=resource.RLIM_INFINITY), hard))

    with _LOCK:
        if not _WANTED:
            _BEFORE[:] = [resource.getrlimit(resource.RLIMIT_AS)]
        _WANTED.append(wanted)
        set_least()
    try:
        yield
    finally:
        with _LOCK:
            _WANTED.remove(wanted)
            set_least()


def limit_private_memory(most_bytes: int | None) -> None:
    """Make allocations fail beyond this much private memory of the process; None: no limit. Only
    Linux has it."""
    resource = _module("resource")
    if resource is None:
        return
    with suppress(ValueError, OSError):
        hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
        soft = hard if most_bytes is None else most_bytes
        resource.setrlimit(resource.RLIMIT_DATA, (soft if hard < 0 else min(soft, hard), hard))


def limits_private_memory() -> bool:
    """Return whether `limit_private_memory` has an effect on this system."""
    return sys.platform == "linux" and _module("resource") is not None


def reset_peak_memory() -> None:
    """Let `peak_memory_bytes` count from now; only Linux can."""
    with suppress(OSError):
        (PROC / "self/clear_refs").write_text("5", encoding="ascii")


def peak_memory_bytes() -> int:
    """Return the largest memory of this process: since `reset_peak_memory` on Linux, since its
    start on macOS, 0 where it is not known."""
    with suppress(OSError, ValueError):
        for line in (PROC / "self/status").read_text(encoding="utf-8").splitlines():
            if line.startswith("VmHWM"):
                return int(line.split()[1]) * 1024
    resource = _module("resource")
    if resource is None:
        return 0
    unit = 1 if sys.platform == "darwin" else 1024
    return int(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss) * unit


def has_nvidia_driver() -> bool:
    """Return whether there may be a driver of NVIDIA: on Windows this is not known before it is
    called."""
    places = (PROC / "driver/nvidia/version", Path("/dev/nvidiactl"))
    return sys.platform == "win32" or any(place.exists() for place in places)


LLVM_PLACES = {
    "linux": (("lib",), "libLLVM.so.*"),
    "darwin": (("lib", "/opt/homebrew/opt/llvm/lib", "/usr/local/opt/llvm/lib"), "libLLVM*.dylib"),
    "win32": (("Library/bin", "C:/Program Files/LLVM/bin"), "LLVM-C.dll"),
}
"""Folders, those of Python's environment first, and names of LLVM. Conda, Homebrew and the
installer of llvm.org put it there; Debian's may be too old for Dr.Jit, which then aborts."""


def llvm_libraries() -> list[Path]:
    """Return the libraries of LLVM that this system has at their usual places, the newest first."""
    folders, name = LLVM_PLACES.get(sys.platform, LLVM_PLACES["linux"])
    for folder in folders:
        for root in (Path(sys.prefix), Path(sys.base_prefix)):
            found = sorted((root / folder).glob(name), key=lambda path: (len(path.name), path.name))
            if found:
                return found[::-1]
    return []


# ---------------------------------------------------------------- signals


def end_as_by_interrupt() -> None:
    """Let the signals by which batch systems, containers and a closed window end a program end it
    as Ctrl-C does."""
    for name in ("SIGTERM", "SIGBREAK"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.default_int_handler)


@contextmanager
def one_interrupt() -> Iterator[None]:
    """Ignore further Ctrl-C after the first, during the shutdown. Without effect outside of the
    main thread and where the caller has its own handler."""

    def interrupt(number: int, frame: object) -> None:
        ignore_interrupts()
        raise KeyboardInterrupt

    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    signal.signal(signal.SIGINT, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def ignore_interrupts() -> None:
    """Ignore Ctrl-C from now on."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextmanager
def interrupts_held_back() -> Iterator[None]:
    """Hold Ctrl-C back, also for processes that start meanwhile, until they ignore it themselves.
    Windows cannot."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def dump_stack_when_asked(file: IO[str]) -> None:
    """Write this thread's stack to a file when another process calls `ask_for_stack`. Windows
    cannot."""
    if hasattr(faulthandler, "register"):
        faulthandler.register(signal.SIGUSR1, file, all_threads=False)


def ask_for_stack(process: int) -> None:
    """Let a process that called `dump_stack_when_asked` write its stack."""
    if hasattr(signal, "SIGUSR1"):
        with suppress(OSError):
            os.kill(process, signal.SIGUSR1)


def cause_of_end(exit_code: int | None) -> str:
    """Return how a process ended: its exit code, or on POSIX the signal that ended it."""
    if exit_code is None or exit_code >= 0:
        return f"its process exited with code {exit_code}"
    name = f"signal {-exit_code}"
    if -exit_code in signal.valid_signals():
        name = signal.Signals(-exit_code).name
    is_killed = name == "SIGKILL"
    why = ": by a user, or by the system because memory ran out" if is_killed else ""
    return f"its process was ended by {name}{why}"


# ---------------------------------------------------------------- start of processes

SAFE_THREADS = ("jemalloc_bg_thd",)
"""Threads that prepare their locks for a fork: that of PyArrow's allocator."""
MOST_FILES = 4096  # numbers of open files that a fork closes


def can_fork() -> bool:
    """Return whether processes can fork from a small server process that has imported what each of
    them would need a second to import. On macOS, system libraries do not survive a fork."""
    import multiprocessing

    return sys.platform == "linux" and "forkserver" in multiprocessing.get_all_start_methods()


def new_processes() -> Any:
    """Return the context of `multiprocessing` for processes that are new interpreters."""
    import multiprocessing

    return multiprocessing.get_context("spawn")


def forked_processes() -> Any:
    """Return the context of `multiprocessing` for processes that are forks of the process of
    `start_fork_server`, or new interpreters where none can fork. They share no locks with this
    one."""
    import multiprocessing

    return multiprocessing.get_context("forkserver") if can_fork() else new_processes()


def start_fork_server(
    preloaded: Sequence[str],
    not_to_fork: Sequence[str],
    in_fork: Callable[[], None],
) -> None:
    """Start the process from which `forked_processes` fork, unless it runs. If it is safe, it
    is a fork of this process, which saves the 1.5 s of processor time in which another interpreter
    imports the ``preloaded`` modules; ``in_fork`` is called in it. It is not safe with one of the
    packages ``not_to_fork`` loaded, or with threads, which might hold a lock."""
    if not can_fork():
        return
    from multiprocessing import forkserver, resource_tracker

    util: Any = importlib.import_module("multiprocessing.util")
    forkserver.set_forkserver_preload(list(preloaded))
    if any(name in sys.modules for name in not_to_fork) or _has_other_threads():
        forkserver.ensure_running()
        return
    for module in preloaded:
        importlib.import_module(module)
    resource_tracker.ensure_running()
    spawned = util.spawnv_passfds

    def forked(path: bytes, arguments: Sequence[Any], kept_files: Sequence[int]) -> int:
        return _fork(arguments[-1], kept_files, in_fork)

    util.spawnv_passfds = forked
    try:
        forkserver.ensure_running()
    finally:
        util.spawnv_passfds = spawned


def _has_other_threads() -> bool:
    """Return whether another thread runs in this process, those of libraries included."""
    try:
        names = [path.read_text(encoding="utf-8").strip() for path in PROC.glob("self/task/*/comm")]
    except OSError:
        return True
    return len([name for name in names if name not in SAFE_THREADS]) != 1


def _fork(program: str, kept_files: Sequence[int], in_fork: Callable[[], None]) -> int:
    """Run Python source in a fork of this process, as a new interpreter would; return the number
    of its process. It is called in place of `multiprocessing.util.spawnv_passfds`."""
    sys.stdout.flush()
    sys.stderr.flush()
    number = os.fork()
    if number:
        return number
    try:
        gc.freeze()  # what is never collected stays shared with this process
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        for first, last in pairwise([2, *sorted(kept_files), MOST_FILES]):
            os.closerange(first + 1, last)
        in_fork()
        exec(program, {})
    except Exception:
        traceback.print_exc()
    finally:
        os._exit(0)


@contextmanager
def starting_processes() -> Iterator[None]:
    """Allow this process to start others even if it is a daemon, as dask's workers are; they start
    with Ctrl-C held back."""
    import multiprocessing

    config: dict[str, Any] = multiprocessing.current_process()._config  # type: ignore[attr-defined]
    daemon = config.get("daemon")
    config["daemon"] = False
    try:
        with interrupts_held_back():
            yield
    finally:
        config["daemon"] = daemon


def search_path() -> str:
    """Return PYTHONPATH for processes that find modules where this one does, not first in the
    folder in which they start."""
    import multiprocessing

    started_in = multiprocessing.process.ORIGINAL_DIR  # type: ignore[attr-defined]
    return os.pathsep.join(path or started_in for path in sys.path)


def end_with_parent() -> None:
    """Let this process end together with the one that started it, whatever it does: on POSIX a
    pipe without a writer sends SIGIO. On Windows it ends when it next reads from or writes to its
    pipe."""
    import multiprocessing

    fcntl = _module("fcntl")
    parent = multiprocessing.parent_process()
    if fcntl is None or parent is None:
        return
    with suppress(AttributeError, OSError):
        parents_end = parent.sentinel
        fcntl.fcntl(parents_end, fcntl.F_SETOWN, os.getpid())
        flags = fcntl.fcntl(parents_end, fcntl.F_GETFL)
        fcntl.fcntl(parents_end, fcntl.F_SETFL, flags | os.O_ASYNC)


# ---------------------------------------------------------------- console and files


def replace_unknown_characters() -> None:
    """Let a terminal that lacks a character such as "±" show "?"."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper) and stream.errors == "strict":
            stream.reconfigure(errors="replace")


def is_closed_pipe(error: OSError) -> bool:
    """Return whether an error may mean that the reader of a pipe is gone; Windows reports an
    invalid argument."""
    return isinstance(error, BrokenPipeError) or (
        sys.platform == "win32" and error.errno == errno.EINVAL
    )


def has_no_reader(output: int) -> bool:
    """Return whether an open file is a pipe that nobody reads any more."""
    if not hasattr(select, "poll"):
        try:
            os.write(output, b"\n")
        except OSError as error:
            return is_closed_pipe(error)
        return False
    poll = select.poll()
    poll.register(output, 0)
    return any(event & select.POLLERR for _, event in poll.poll(0))


RENAMES_S = 2.0
IN_USE = (5, 32)  # Windows' "access denied" and "sharing violation"


def flags_of_plain_file() -> int:
    """Return the flags of `os.open` by which it follows no link, waits for no pipe and changes no
    line's end, as far as the system has them."""
    flags = 0
    for name in ("O_NOFOLLOW", "O_NONBLOCK", "O_BINARY"):
        flags |= getattr(os, name, 0)
    return flags


def flush_to_disk(path: Path) -> None:
    """Flush a written file to the disk. Windows flushes only what is open for writing."""
    with open(path, "r+b") as file:
        os.fsync(file.fileno())


def replace(source: Path, target: Path) -> None:
    """Rename a file or folder over ``target``. Windows renames nothing over a file that is open,
    as a scanner of viruses may keep it for a moment: it is tried again for `RENAMES_S`."""
    until_s = time.monotonic() + RENAMES_S
    while True:
        try:
            os.replace(source, target)
            return
        except PermissionError as error:
            is_open = getattr(error, "winerror", None) in IN_USE
            if not is_open or time.monotonic() > until_s:
                raise
            time.sleep(WAITS_S)


def link_or_copy(folder: Path, name: Path) -> None:
    """Give a folder a second name beside it: a link, or a copy where the user may make none, as on
    Windows."""
    try:
        name.symlink_to(folder.name, target_is_directory=True)
    except (OSError, NotImplementedError):
        shutil.copytree(folder, name)
