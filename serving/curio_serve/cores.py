"""How many cores and how much memory this process may use."""

from pathlib import Path

from curio_serve.systems import usable_cores

_CGROUP = Path("/sys/fs/cgroup")
# Quota and period in microseconds, as cgroup v2 and v1 give a container its own.
_QUOTA_FILES = (("cpu.max",), ("cpu/cpu.cfs_quota_us", "cpu/cpu.cfs_period_us"))
_MEMORY_FILES = ("memory.max", "memory/memory.limit_in_bytes")
_UNLIMITED = ("max", "-1")


def num_cores(cgroup: Path = _CGROUP) -> int:
    """Number of cores: those of its affinity or its container's quota, whichever is less; at least 1.

    Args:
        cgroup: Where control groups are mounted.
    """
    cores = usable_cores()
    quota = _quota(cgroup)
    return cores if quota is None else max(1, min(cores, round(quota)))


def _quota(cgroup: Path) -> float | None:
    """Number of cores that the quota allows; None without a quota."""
    for names in _QUOTA_FILES:
        try:
            quota, period = " ".join((cgroup / name).read_text() for name in names).split()
            return None if quota in _UNLIMITED else int(quota) / int(period)
        except (OSError, ValueError):
            continue
    return None


def memory_limit() -> int | None:
    """Bytes that the container may use; None without a limit."""
    for name in _MEMORY_FILES:
        try:
            text = (_CGROUP / name).read_text().strip()
            return None if text in _UNLIMITED else int(text)
        except (OSError, ValueError):
            continue
    return None
