"""Processes of the stack's nodes on this machine, and their sockets, as Linux lists them."""

from __future__ import annotations

import ipaddress
import os
import re
from pathlib import Path

from contact_reach_ros.resources import PACKAGE
from contact_reach_ros.ros.interfaces import INTERFACES

_TABLES = ("udp", "udp6", "tcp", "tcp6")
_MODULE = re.compile(rf"{PACKAGE}\.(?:nodes|bringup)\.(\w+)")
_NAMESPACE = "__ns:="
_PROC = Path("/proc")


def node_processes(
    domain: str, proc: Path = _PROC, user: int | None = None, namespace: str | None = None
) -> dict[int, str]:
    """Find the processes of this package's nodes in a ROS domain; returns the node's name by process id.

    Parameters
    ----------
    domain
        ROS_DOMAIN_ID.
    proc
        Where procfs is mounted.
    user
        Who owns the processes; None for everybody whose processes may be looked at.
    namespace
        Of the nodes; None for any.
    """
    found = {}
    for folder in proc.iterdir():
        if not folder.name.isdigit():
            continue
        try:
            if user is not None and folder.stat().st_uid != user:
                continue
            arguments = (folder / "cmdline").read_bytes().decode(errors="replace").split("\0")
            env = (folder / "environ").read_bytes().split(b"\0")
        except OSError:  # ended meanwhile, or another user's
            continue
        name = _node_name(arguments)
        domains = [entry.partition(b"=")[2].decode() for entry in env if entry.startswith(b"ROS_DOMAIN_ID=")]
        spaces = [argument.removeprefix(_NAMESPACE) for argument in arguments if argument.startswith(_NAMESPACE)]
        if namespace is not None and (spaces or ["/"])[-1] != namespace:
            continue
        if name and (domains or ["0"])[0] == domain:
            found[int(folder.name)] = name
    return found


def _node_name(arguments: list[str]) -> str:
    """Name of the node that a command line runs, by `python -m` or as an executable; empty if it runs none."""
    for index, argument in enumerate(arguments[:4]):
        module = _MODULE.fullmatch(argument) if index and arguments[index - 1] == "-m" else None
        # As the script of an interpreter, or below the package's own folder for executables.
        executable = argument.startswith("/") and (index == 1 or f"/{PACKAGE}/" in argument)
        name = module[1] if module else argument.rpartition("/")[2] if executable else ""
        if name in INTERFACES:
            return name
    return ""


def bound_addresses(process: int) -> set[str]:
    """Find the local addresses of the UDP and TCP sockets of a process of the same user.

    Raises `OSError` if there is no such process, or it belongs to another user.
    """
    own = set()
    for file in (_PROC / str(process) / "fd").iterdir():
        try:
            own.add(os.readlink(file))
        except OSError:  # closed meanwhile
            continue
    found = set()
    for table in _TABLES:
        path = _PROC / str(process) / "net" / table
        for line in path.read_text().splitlines()[1:] if path.is_file() else []:
            columns = line.split()
            if f"socket:[{columns[9]}]" in own:
                found.add(_address(columns[1].partition(":")[0]))
    return found


def stays_on_this_host(address: str) -> bool:
    """Whether a socket bound to this address sends and receives by loopback only.

    A socket bound to a multicast group receives what is sent to the group, on the interfaces where it was joined. Fast
    DDS joins on the interfaces of its profile, and binds one socket to each of them to send, so those decide.
    """
    bound = ipaddress.ip_address(address)
    return bound.is_loopback or bound.is_multicast


def _address(text: str) -> str:
    """Read an address of a table in /proc/net: 32-bit words, each in the byte order of the machine (little-endian)."""
    data = b"".join(bytes.fromhex(text[start : start + 8])[::-1] for start in range(0, len(text), 8))
    address = ipaddress.ip_address(data)
    return str(getattr(address, "ipv4_mapped", None) or address)
