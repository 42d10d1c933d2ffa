"""Two machines made up on one: network namespaces, joined by a link of a given rate and delay. Linux, root.

A pair of virtual cards joins them, and tc's token bucket holds their rate (`ip`, `tc`). Where there is to be
a delay, packets go through a program that keeps each one for so long, since not every kernel can delay
packets itself. All that is made is removed at the end.
"""

from __future__ import annotations

import os
import select
import shutil
import signal
import struct
import subprocess
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from fcntl import ioctl

SPACES = "hqgs-a", "hqgs-b"
HOSTS = "10.77.0.1", "10.77.0.2"
CARD, FAR = "net0", "far0"  # in each of the two: the direct way, and the one with the delay
MTU = 9000
TUNSETIFF, IFF_TUN, IFF_NO_PI = 0x400454CA, 1, 0x1000


@dataclass(frozen=True)
class Link:
    """What joins the two machines."""

    name: str
    rate: float = 0.0  # bit/s; 0: no limit
    delay: float = 0.0  # s, one way


def tool(*command: object, space: str | None = None) -> None:
    """Run it, in a namespace. RuntimeError says what it said."""
    inside = ["ip", "netns", "exec", space] if space else []
    done = subprocess.run([*inside, *map(str, command)], capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{' '.join(map(str, command))}: {done.stderr.strip()}")


def set_link(rank: int, link: Link) -> None:
    """Give the card of this namespace another rate, and the way over it another delay."""
    for card in (CARD, FAR):
        subprocess.run(["tc", "qdisc", "del", "dev", card, "root"], capture_output=True, check=False)
        if link.rate:
            burst = max(128_000, round(link.rate / 8 * 1e-3))  # what passes in a millisecond
            bucket = f"rate {link.rate:.0f}bit burst {burst} latency 200ms"
            tool(*f"tc qdisc add dev {card} root tbf {bucket}".split())
    way = f"{HOSTS[1 - rank]}/32"
    subprocess.run(["ip", "route", "del", way], capture_output=True, check=False)
    if link.delay:
        tool(*f"ip route add {way} dev {FAR} src {HOSTS[rank]}".split())


class Wire:
    """Carries packets between two TUN cards and keeps each for a while."""

    def __init__(self, delay: float) -> None:
        self.delay = delay
        self.ends = [os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK) for _ in SPACES]
        for rank, (end, space) in enumerate(zip(self.ends, SPACES, strict=True)):
            made = f"hqgsfar{rank}"
            ioctl(end, TUNSETIFF, struct.pack("16sH22x", made.encode(), IFF_TUN | IFF_NO_PI))
            tool("ip", "link", "set", made, "netns", space)
            tool("ip", "link", "set", made, "name", FAR, "mtu", MTU, "up", space=space)
        threading.Thread(target=self._carry, daemon=True).start()

    def _carry(self) -> None:
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), -10)  # a wire waits for no other program
        waiting: deque[tuple[float, int, bytes]] = deque()
        while True:
            pause = waiting[0][0] - time.perf_counter() if waiting else None
            readable, _, _ = select.select(self.ends, [], [], pause and max(pause, 0.0))
            due = time.perf_counter() + self.delay
            for end in readable:
                other = self.ends[1 - self.ends.index(end)]
                try:
                    waiting.append((due, other, os.read(end, 65_536)))
                except OSError:
                    return  # the namespaces are gone
            while waiting and waiting[0][0] <= time.perf_counter():
                _, other, packet = waiting.popleft()
                with suppress(OSError):  # a card that is down loses it
                    os.write(other, packet)


@contextmanager
def machines(delay: float) -> Iterator[None]:
    """Two namespaces, joined; what could not be made is a RuntimeError."""
    if os.geteuid() != 0 or not (shutil.which("ip") and shutil.which("tc")):
        raise RuntimeError("network namespaces need root, and ip and tc (Debian: apt-get install iproute2)")
    try:
        for space in SPACES:
            tool("ip", "netns", "add", space)
        ends = f"{CARD} mtu {MTU} netns"
        tool(*f"ip link add {ends} {SPACES[0]} type veth peer name {ends} {SPACES[1]}".split())
        for space, host in zip(SPACES, HOSTS, strict=True):
            tool("ip", "link", "set", "lo", "up", space=space)
            tool("ip", "address", "add", f"{host}/24", "dev", CARD, space=space)
            tool("ip", "link", "set", CARD, "up", space=space)
        Wire(delay)
        yield
    finally:
        for space in SPACES:
            inside = subprocess.run(
                ["ip", "netns", "pids", space], capture_output=True, text=True, check=False
            )
            for process in inside.stdout.split():
                with suppress(OSError):
                    os.kill(int(process), signal.SIGKILL)
            subprocess.run(["ip", "netns", "del", space], capture_output=True, check=False)
