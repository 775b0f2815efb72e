"""How much memory this process can still take, and errors where that is too little.

The errors are raised before the memory is taken.
"""

import math
import mmap
from pathlib import Path

from pgo_models.errors import PGOError


def available_memory() -> float:
    """Bytes that this process may still take, by its limits and by what the machine has.

    It is inf where the system does not say.
    """
    process = _sizes_in("/proc/self/status")
    machine = _sizes_in("/proc/meminfo")
    bounds = [
        _left_of("RLIMIT_AS", process.get("VmSize")),
        _left_of("RLIMIT_DATA", process.get("VmData")),
    ]
    if "MemAvailable" in machine:
        bounds.append(machine["MemAvailable"] + machine.get("SwapFree", 0.0))
    return max(0.0, min(bounds))


def check_memory(needed: float, what: str, way_out: str) -> None:
    """Raise a PGOError when something needs more memory, in bytes, than is available."""
    available = available_memory()
    if needed > available:
        raise PGOError(
            f"{what} takes about {_in_words(needed)} of memory, "
            f"and {_in_words(available)} is available; {way_out}"
        )


def check_room(num_bytes: int) -> None:
    """Raise a MemoryError when there is no room for so many bytes.

    It is called before a library that crashes without this room.
    """
    try:
        mmap.mmap(-1, max(num_bytes, 1)).close()
    except OSError as error:
        raise MemoryError(f"there is no room for {_in_words(num_bytes)}") from error


def _in_words(num_bytes: float) -> str:
    """Size with its unit."""
    if num_bytes >= 1e9:
        return f"{1e-9 * num_bytes:.2g} GB"
    return f"{1e-6 * num_bytes:.3g} MB"


def _left_of(limit: str, used: float | None) -> float:
    """Bytes left of a limit; inf where there is none, or the system does not say."""
    try:
        import resource
    except ImportError:  # Windows
        return math.inf
    most, _ = resource.getrlimit(getattr(resource, limit))
    if most == resource.RLIM_INFINITY or used is None:
        return math.inf
    return most - used


def _sizes_in(path: str) -> dict[str, float]:
    """Sizes in a file of /proc, in bytes, by name; none where the system has no such file."""
    try:
        lines = Path(path).read_text(encoding="ascii", errors="replace").splitlines()
    except OSError:
        return {}
    sizes = {}
    for line in lines:
        words = line.split()
        if words[2:] == ["kB"]:
            name = words[0].rstrip(":")
            sizes[name] = 1024.0 * float(words[1])
    return sizes
