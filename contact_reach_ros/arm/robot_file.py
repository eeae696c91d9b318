"""Files that describe robots, all read as the <robot> element of a URDF: URDF, xacro and MJCF."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Mapping
from itertools import chain
from pathlib import Path
from urllib.parse import unquote
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from contact_reach_ros.arm.table import ArmOptions
from contact_reach_ros.errors import SettingsError

DESCRIPTIONS = (".urdf", ".xacro", ".xml")
"""Endings of files that describe robots, in any case."""
POINTS = "points"
"""Geometry beside that of URDFs: the convex hull of the points in its attribute `at`, m."""
_FILE_URI = re.compile("^file:(//(localhost)?(?=/))?")
_PACKAGED = re.compile("(?:(?:package|model)://|.*/share/)([^/]+)/(.+)")
_ARGUMENT = re.compile(rb"""<xacro:arg\s[^>]*?name=["']([^"']+)["']|\$\(arg\s+([^)\s]+)\s*\)""")
"""Where a xacro file declares an argument, or uses one."""
_PREFIX_PATHS = ("AMENT_PREFIX_PATH", "ROS_PACKAGE_PATH")


def read_robot_file(file: Path, options: ArmOptions) -> tuple[Element, list[str]]:
    """The <robot> of a URDF, an expanded xacro file or a converted MJCF, and what the file cannot say, in words.

    The content decides how a file is read, whatever its ending.

    Raises `SettingsError` if the file cannot be read, is none of these, or `xacro` is not installed; the message names
    the file.
    """
    content = _content(file)
    root = parse_xml(content, file)
    is_xacro = b"${" in content or b"$(" in content or any(each.tag.startswith("xacro:") for each in root.iter())
    if options.xacro and (root.tag == "mujoco" or not is_xacro):
        raise SettingsError(
            f"{file}: is no xacro file; expected no arguments under xacro, got {', '.join(options.xacro)}"
        )
    if root.tag == "mujoco":
        # MuJoCo is loaded for its own files only.
        from contact_reach_ros.arm.mjcf_reader import robot_of_mjcf

        return robot_of_mjcf(file)
    if is_xacro:
        root = parse_xml(_expanded(root, file, options), file)
    if root.tag != "robot":
        raise SettingsError(f"{file}: its root is <{root.tag}>; expected <robot> (URDF, xacro) or <mujoco> (MJCF)")
    return root, []


def _content(file: Path) -> bytes:
    try:
        return file.read_bytes()
    except OSError as error:
        expected = "give the path of a URDF, xacro or MJCF file"
        raise SettingsError(f"{file}: cannot be read ({error.strerror}); {expected}") from error


def parse_xml(content: bytes | str, source: Path | str) -> Element:
    """The root element; prefixes stay parts of names, so that undeclared ones do no harm.

    Raises `SettingsError`, beginning with `source`, if it is none.
    """
    builder, parser = TreeBuilder(), expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = builder.start, builder.end
    parser.CharacterDataHandler = builder.data
    # Nothing is read from other files: expat would leave it out silently.
    parser.ExternalEntityRefHandler = lambda *_: 0
    try:
        parser.Parse(content, True)
    # The others are of encodings that Python does not know, or that expat cannot use.
    except (expat.ExpatError, LookupError, ValueError) as error:
        raise SettingsError(f"{source}: not valid XML: {error}; expected a URDF, xacro or MJCF file") from error
    return builder.close()


def _expanded(root: Element, file: Path, options: ArmOptions) -> bytes:
    try:
        import xacro
        from xacro import substitution_args
    except ImportError as error:
        raise SettingsError(
            f"{file}: is a xacro file, which the package 'xacro' expands; install it: pip install xacro"
        ) from error

    missing = []

    def find(package: str) -> str:
        for folder in package_folders(package, file, options.packages):
            return str(folder)
        missing.append(package)
        raise LookupError

    # By itself xacro finds packages that are installed with ROS, and no others.
    substitution_args._eval_find = substitution_args._eval_dict["find"] = find
    given = {key: f"{value}".lower() if isinstance(value, bool) else f"{value}" for key, value in options.xacro.items()}
    xacro.all_includes.clear()
    try:
        text: str = xacro.process_file(str(file), mappings=given).toxml()
    # Macros are expressions in Python and may raise whatever these do.
    except Exception as error:
        if missing:
            expected = "give its folder under packages"
            raise SettingsError(f"{file}: package '{missing[0]}' is not found; {expected}") from error
        defaults = {each.get("name"): each.get("default") or "''" for each in root.iter("xacro:arg")}
        arguments = ", ".join(f"{name}: {default}" for name, default in defaults.items() if "$(" not in default)
        declared = f"its arguments under xacro ({{{arguments}}}), " if arguments else ""
        mend = f"give {declared}folders of its packages under packages"
        raise SettingsError(f"{file}: xacro does not expand it: {str(error) or repr(error)}; {mend}") from error
    used = [name for each in (file, *map(Path, xacro.all_includes)) for name in _ARGUMENT.findall(_content(each))]
    known = {name.decode() for names in used for name in names if name}
    if unknown := [name for name in given if name not in known]:
        expected = f"one of {', '.join(sorted(known))}" if known else "none, since it has none"
        raise SettingsError(f"{file}: xacro argument '{unknown[0]}' is unknown; expected {expected}")
    return text.encode()


def package_folders(package: str, file: Path, packages: Mapping[str, str]) -> Iterator[Path]:
    """Folders that a ROS package may be in for a robot's file: given, around the file, and where ROS looks.

    A package has the name that its package.xml says, or that of its folder.
    """
    if package in packages:
        yield file.parent / packages[package]
    installed = [Path(prefix) for key in _PREFIX_PATHS for prefix in os.environ.get(key, "").split(":") if prefix]
    around = [*file.resolve().parents, *(prefix / "share" for prefix in installed), *installed]
    yield from (folder for folder in around if _is_package(folder / "package.xml", package))
    yield from (folder / package for folder in around if (folder / package).is_dir())
    for folder in around:
        yield from (path.parent for path in folder.glob("*/package.xml") if _is_package(path, package))


def _is_package(file: Path, package: str) -> bool:
    try:
        return (parse_xml(_content(file), file).findtext("name") or "").strip() == package
    except SettingsError:
        return False


def find_mesh(name: str, file: Path, packages: Mapping[str, str]) -> Path | None:
    """The mesh that a robot's file names, beside it or in a package; None if there is no such file.

    A path with share/ is that of an installed package, which files expanded on another machine have.
    """
    packaged = _PACKAGED.match(name)
    paths: Iterable[Path] = [file.parent / _FILE_URI.sub("", each) for each in (name, unquote(name))]
    if packaged:
        paths = chain(paths, (folder / packaged[2] for folder in package_folders(packaged[1], file, packages)))
    return next((path for path in paths if os.path.isfile(path)), None)
