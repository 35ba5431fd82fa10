"""Abilities of the processor, as the operating system tells them."""

from __future__ import annotations

import sys
from functools import lru_cache
from pathlib import Path

#: Instructions of the level x86-64-v3, most processors since 2013 (Intel) and 2015 (AMD), by their names in Linux.
X86_64_V3 = frozenset({"abm", "avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "movbe", "popcnt", "sse4_2", "xsave"})


@lru_cache(maxsize=1)
def cpu_flags() -> frozenset[str]:
    """Flags of the first processor that this process can use, by their names in Linux; none where they are not known.

    Known on Linux for x86 only.
    """
    return frozenset(_said("flags").split())


@lru_cache(maxsize=1)
def is_amd() -> bool:
    """True for a processor of AMD; known on Linux for x86 only."""
    return _said("vendor_id") == "AuthenticAMD"


def _said(name: str) -> str:
    """The value under a name in what Linux says of the first processor; empty where there is none."""
    if sys.platform != "linux" or not Path("/proc/cpuinfo").exists():
        return ""
    with Path("/proc/cpuinfo").open(encoding="ascii", errors="replace") as lines:
        found = next((line for line in lines if line.startswith(name)), "")
    return found.partition(":")[2].strip()
