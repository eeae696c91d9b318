"""What the processes of the stack listen and send on, as Linux knows it."""

from __future__ import annotations

import ipaddress
import os
import re
from pathlib import Path

_TABLES = ("udp", "udp6", "tcp", "tcp6")
_MODULE = re.compile(r"contact_reach_ros[./](?:nodes[./])?(\w+)$")


def bound_addresses(process: int) -> set[str]:
    """Local addresses of the UDP and TCP sockets of a process of the same user.

    Raises
    ------
    OSError
        If there is no such process, or it belongs to somebody else.
    """
    own = set()
    for file in Path(f"/proc/{process}/fd").iterdir():
        try:
            own.add(os.readlink(file))
        except OSError:  # closed meanwhile
            continue
    found = set()
    for table in _TABLES:
        path = Path(f"/proc/{process}/net/{table}")
        for line in path.read_text().splitlines()[1:] if path.is_file() else []:
            columns = line.split()
            if f"socket:[{columns[9]}]" in own:
                found.add(_address(columns[1].partition(":")[0]))
    return found


def stays_on_this_host(address: str) -> bool:
    """Whether nothing that a socket bound to this address sends or receives passes another interface than loopback.

    A socket bound to a multicast group receives what is sent to the group, on the interfaces where it was joined. Fast
    DDS joins on the interfaces of its profile, and binds one socket to each of them to send, so those decide.
    """
    bound = ipaddress.ip_address(address)
    return bound.is_loopback or bound.is_multicast


def node_processes(domain: str) -> dict[int, str]:
    """Processes of this package's nodes in a ROS domain, as far as they may be looked at: id and name of the node."""
    found = {}
    for folder in Path("/proc").iterdir():
        if not folder.name.isdigit():
            continue
        try:
            arguments = (folder / "cmdline").read_bytes().decode(errors="replace").split("\0")
            env = (folder / "environ").read_bytes().split(b"\0")
        except OSError:
            continue
        name = _node_name(arguments)
        domains = [entry.partition(b"=")[2].decode() for entry in env if entry.startswith(b"ROS_DOMAIN_ID=")]
        if name and (domains or ["0"])[0] == domain:
            found[int(folder.name)] = name
    return found


def _node_name(arguments: list[str]) -> str:
    """Name of the node that a command line runs, by `python -m` or by the executable of `ros2 run`."""
    for argument in arguments[1:4]:
        match = _MODULE.search(argument)
        if match and match[1] not in ("cli", "contact"):
            return match[1]
    return ""


def _address(text: str) -> str:
    """An address of a table in /proc/net: 32-bit words, each in the byte order of the machine (little-endian)."""
    data = b"".join(bytes.fromhex(text[start : start + 8])[::-1] for start in range(0, len(text), 8))
    address = ipaddress.ip_address(data)
    mapped = getattr(address, "ipv4_mapped", None)
    return str(mapped or address)
