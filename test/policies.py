"""SROS 2 policies: each node may use its topics and services, and nothing else.

`python test/policies.py config/security` writes the files that the package ships; docs/security.md
explains how to use them.
"""

from __future__ import annotations

import sys
from collections.abc import Collection
from pathlib import Path
from xml.etree import ElementTree

from interfaces import INTERFACES, Interface

from contact_reach_ros.bringup.processes import ENCLAVES

FORMAT_VERSION = "0.2.0"
"""Of the policy language of SROS 2."""


def policy(name: str, interface: Interface) -> str:
    """The policy file of one node, XML."""
    root = ElementTree.Element("policy", version=FORMAT_VERSION)
    enclave = ElementTree.SubElement(ElementTree.SubElement(root, "enclaves"), "enclave", path=f"{ENCLAVES}/{name}")
    profile = ElementTree.SubElement(ElementTree.SubElement(enclave, "profiles"), "profile", ns="/", node=name)
    _allow(profile, "topic", "publish", interface.publishes)
    _allow(profile, "topic", "subscribe", interface.subscribes)
    _allow(profile, "service", "reply", interface.serves)
    _allow(profile, "service", "request", interface.calls)
    ElementTree.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def _allow(profile: ElementTree.Element, kind: str, act: str, names: Collection[str]) -> None:
    if names:
        group = ElementTree.SubElement(profile, f"{kind}s", {act: "ALLOW"})
        for name in sorted(names):
            ElementTree.SubElement(group, kind).text = name


def write_policies(folder: Path) -> None:
    """Write one file for each node into a folder, which is made if it does not exist."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, interface in INTERFACES.items():
        (folder / f"{name}.policy.xml").write_text(policy(name, interface))


if __name__ == "__main__":
    write_policies(Path(sys.argv[1]))
