"""Every command in the documentation is one that there is, and those that need no robot do what they should."""

import contextlib
import importlib
import io
import itertools
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest
import yaml
from interfaces import INTERFACES
from stack_helpers import SMALL_PLANNER, parameter_file, ready, running
from stack_helpers import environment as stack_environment

from contact_reach_ros.arm.urdf import build_urdf
from contact_reach_ros.arms import load_arm
from contact_reach_ros.bringup.settings import BringupOptions
from contact_reach_ros.cli import _parser
from contact_reach_ros.messages import topics
from contact_reach_ros.nodes import replay
from contact_reach_ros.presets import SECTIONS
from contact_reach_ros.ros.parameters import check_arguments, without_ros_arguments

ROOT = Path(__file__).parents[1]
PAGES = ("README.md", "bags/README.md", "benchmarks/*.md", *(f"{folder}/*.md" for folder in ("docs", "msg_docs")))
PROGRAM = ("contact-reach", ".venv/bin/contact-reach")
NODE = re.compile(r"\.venv/bin/(?!contact-reach)(\w+)")


class Command(NamedTuple):
    """One command of a page."""

    page: str
    line: str
    """As a shell takes it, without its comment."""

    @property
    def words(self) -> list[str]:
        """Program and arguments, without variables that are set for it."""
        # docs/real_robot.md lets the reader choose.
        words = shlex.split(self.line.replace("$KIND", "lbr"))
        while re.match(r"[A-Z_]+=", words[0]):
            words = words[1:]
        return words


def commands() -> list[Command]:
    """All commands, page by page in their order."""
    pages = sorted(page for pattern in PAGES for page in ROOT.glob(pattern))
    return [Command(str(page.relative_to(ROOT)), line) for page in pages for line in _lines(page)]


def _lines(page: Path) -> list[str]:
    lines = []
    for language, block in re.findall(r"^```(\w*)\n(.*?)^```$", page.read_text(), re.DOTALL | re.MULTILINE):
        if language:
            continue
        joined = re.sub(r"\\\n\s*", " ", block)
        # A loop is one command.
        joined = re.sub(r"^for .*?^done$", lambda loop: "; ".join(loop[0].split("\n")), joined, flags=re.S | re.M)
        lines += [re.sub(r"\s+# .*", "", line) for line in joined.splitlines() if line.strip()]
    return lines


COMMANDS = commands()
TEXTS = sorted(page for pattern in (*PAGES, "CHANGELOG.md") for page in ROOT.glob(pattern))
PARSER = _parser()
SHELL = ("cd", "cp", "export", "for", "printf", "source")
INSTALLING = ("make venv", "make build")
LAUNCH = ROOT / "launch"
OF_DRIVERS = ("controller_manager", "franka_bringup", "lbr_bringup")
"""Packages whose commands are theirs."""
TARGETS = re.findall(r"^(\w+):.*## ", (ROOT / "Makefile").read_text(), re.MULTILINE)


def check_node(name, arguments):
    if name == "replay":
        replay.make_parser().parse_args(without_ros_arguments([name, *arguments])[1:])
    else:
        assert arguments[:1] in ([], ["--ros-args"]), arguments
        check_arguments([name, *arguments], name, SECTIONS[name])


def check_ros2(words):
    match words:
        case ["run", "contact_reach_ros", name, *arguments]:
            check_node(name, arguments)
        case ["launch", "contact_reach_ros", file, *arguments]:
            assert (LAUNCH / file).is_file()
            given = dict(text.split(":=", 1) for text in arguments if text != "-s")
            of_launch = re.findall(r'^    "(\w+)": \("', (LAUNCH / "bringup.launch.py").read_text(), re.MULTILINE)
            values = {name: yaml.safe_load(text) for name, text in given.items() if name not in of_launch}
            values |= {"overrides": shlex.split(given["overrides"])} if "overrides" in given else {}
            BringupOptions.from_mapping(values, "launch")
        case ["launch" | "run", package, *_] if package in OF_DRIVERS:
            pass
        case ["topic", "pub", "--once", name, kind, content]:
            assert kind == topics.find(name).type_name and isinstance(yaml.safe_load(content), dict)
        case ["service", "call", name, "std_srvs/srv/Trigger"]:
            _, node, service = name.split("/")
            assert f"~/{service}" in INTERFACES[node].serves
        case _:
            assert words[0] in ("security", "pkg"), words


def check_program(arguments):
    options = vars(PARSER.parse_args(arguments))
    if arguments[0] == "up":
        names = {entry.name for entry in BringupOptions.declared()}
        BringupOptions.from_mapping({name: value for name, value in options.items() if name in names}, "up")


def check_module(module, arguments):
    main_of = importlib.import_module(module).main
    with contextlib.redirect_stdout(io.StringIO()) as printed, pytest.raises(SystemExit):
        main_of(["--help"])
    options = [word for word in shlex.split(arguments) if word.startswith("--")]
    assert all(option in printed.getvalue() for option in options), (module, arguments)


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: f"{command.page}: {command.line[:60]}")
def test_every_command_is_one_that_there_is(command):
    program, *arguments = command.words
    if program in PROGRAM:
        check_program(arguments)
    elif node := NODE.fullmatch(program):
        check_node(node[1], arguments)
    elif command.line.startswith("python -m benchmarks."):
        check_module(arguments[1], shlex.join(arguments[2:]))
    elif program == "ros2":
        check_ros2(arguments)
    elif program == "make" and arguments[0] == "bench":
        module, options = f"benchmarks.{arguments[1].removeprefix('NAME=')}", " ".join(arguments[2:])
        check_module(module, options.removeprefix("ARGS="))
    elif program == "make":
        assert arguments[0] in TARGETS or arguments[0] == "-C", command
        for text in arguments[1:]:
            if text.startswith("PYTHON="):
                continue
            check_program([arguments[0], *shlex.split(text.removeprefix("ARGS="))])
    else:
        assert program in SHELL or command.line.startswith(INSTALLING), command


def test_what_bringup_takes_up_takes():
    words = "up --scene ball --arm fr3 --state-rate 500 --adapter lbr --parameters FILE --discovery subnet --bag DIR"
    options = PARSER.parse_args([*words.split(), "--lockstep", "--no-driver", "--view", "--set", "driver:seed=1"])
    assert set(vars(options)) - {"run"} == {entry.name for entry in BringupOptions.declared()}


@pytest.mark.parametrize("page", TEXTS, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    """To files that are there, and to headings that they have."""
    for target, _, anchor in re.findall(r"\]\((?!http)([^)#\s]*)(#([^)\s]+))?\)", page.read_text()):
        file = page.parent / target if target else page
        assert file.exists(), target
        assert not anchor or anchor in headings(file), (target, anchor)


def headings(page: Path) -> set[str]:
    """Anchors that GitHub makes of the headings."""
    titles = re.findall(r"^#+ (.*)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


# What is run.

NOT_RUN = {
    r"ros2 |source /opt/ros|source install|cd \$\(ros2|for policy|export ROS_SEC|ROS_SECURITY": "needs ROS 2 sourced",
    r"contact-reach bench|make bench|make -C|python -m benchmarks": "takes minutes to hours; see test/benchmarks",
    r"--no-driver|\$KIND": "needs a robot; test/stacks/test_standins.py has the stages of real_robot.md",
    r"^cp ": "belongs to one of them",
    r"--namespace": "needs two stacks; test/stacks/test_namespaces.py has them",
    r"contact-reach identify\b": "moves the arm; test/stacks has a stack for it",
    r"--discovery subnet": "opens the nodes to the network",
    r"make (test|build|venv)": "installs: see the test of installation; make build: test_package",
}
ENDLESS = {
    r"contact-reach up": "all nodes are active",
    r"contact-reach view": "open http",
    r"contact-reach demo .*--view": "the episode is over",
    r"\.venv/bin/(?!replay|contact-reach)": "active",
}
"""Commands that run until Ctrl-C, with what they print when they are up."""
WITH_STACK = r"contact-reach (goto|home|speed|stop|reset|doctor)"
OTHER_CODES = {r"contact-reach doctor": (0, 1), r"\.venv/bin/(?!replay|contact-reach)": (0,)}
"""The doctor may find fault with the machine; a node that has just become active ends by the signal itself."""
ANY_PORT = {"port": 0}


def is_run(command: Command) -> bool:
    return not any(re.search(pattern, command.line) for pattern in NOT_RUN)


def adapted(line: str) -> str:
    """The command as it is run here: in lockstep or fast, on any port, with names filled in, into bags that are new."""
    line = re.sub(r"^make demo(?: ARGS=\"?(.*?)\"?)?$", lambda found: f"contact-reach demo {found[1] or ''}", line)
    line = re.sub(r"\bOTHER_BAG\b", "bags/first", re.sub(r"\bBAG\b", "bags/sample", line))
    # Commands of other pages have left bags, too.
    line = re.sub(r"(\S+)<date>", r"$(ls -dt \1*[0-9] | head -1)", line)
    line = re.sub(r"(--bag |bag:=|--output )bags/(first|sample)", r"\1bags/new_\2", line)
    if re.search(r"contact-reach (demo|up)", line):
        line += " --lockstep" * ("--lockstep" not in line)
    if ".venv/bin/replay" in line:
        line = re.sub(r" --rate \S+|$", " --rate 50", line, count=1)
    if "contact-reach up" in line:
        line += " --parameters small.yaml"
    elif "--view" in line:
        line += " --parameters any_port.yaml"
    return line + " --port 0" * ("contact-reach view" in line)


RUN: set[tuple[str, ...]] = set()
"""Forms of commands that have been run."""


def is_new(line: str) -> bool:
    """Whether no command of this form, with the same words and options of whatever values, has been run yet."""
    program, *words = shlex.split(line)
    if program in SHELL:
        return True
    subcommands = itertools.takewhile(str.isalpha, words)
    form = (program, *subcommands, str(len(words)), *sorted(word for word in words if word.startswith("--")))
    if form in RUN:
        return False
    RUN.add(form)
    return True


def test_enough_commands_are_run():
    assert sum(map(is_run, COMMANDS)) >= 30


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A folder like a checkout, for one command after the other."""
    folder = tmp_path_factory.mktemp("checkout")
    (folder / ".venv").mkdir()
    (folder / ".venv" / "bin").symlink_to(Path(sys.executable).parent)
    for bag in ("sample", "first"):
        shutil.copytree(ROOT / "bags" / "sample", folder / "bags" / bag)
    (folder / "my_scene.yaml").write_text("base: free\n")
    (folder / "my_arm.urdf").write_text(build_urdf(load_arm("iiwa7")))
    parameter_file(folder / "small.yaml", planner=SMALL_PLANNER, viewer=ANY_PORT)
    parameter_file(folder / "any_port.yaml", viewer=ANY_PORT)
    return folder


def environment() -> dict[str, str]:
    """Of a domain that nothing else uses, with the commands in the path."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    inherited = stack_environment()
    # A user has none, and with other options for XLA the sample's plans differ by more than rounding.
    inherited.pop("XLA_FLAGS")
    return {**inherited, "PATH": path, "PYTHONPATH": str(ROOT)}


def shell(line: str, folder: Path) -> list[str]:
    """A command that becomes the program of a line, in a folder."""
    return ["bash", "-c", f"cd {folder} && exec {line}"]


@pytest.fixture(scope="module")
def stack(folder):
    """Environment of a running stack."""
    env, output = environment(), folder / "stack.txt"
    line = "contact-reach up --scene free --lockstep --parameters small.yaml"
    with running(shell(line, folder), env, output) as process:
        ready(process, output)
        yield env
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 0


@pytest.mark.slow
@pytest.mark.parametrize("page", sorted({command.page for command in COMMANDS if is_run(command)}))
def test_commands_that_need_no_robot(page, folder, request):
    for command in COMMANDS:
        if command.page != page or not is_run(command):
            continue
        line = adapted(command.line)
        if not is_new(line):
            continue
        for bag in (folder / "bags").glob("new_*"):
            shutil.rmtree(bag)
        env = request.getfixturevalue("stack") if re.search(WITH_STACK, line) else environment()
        marker = next((marker for pattern, marker in ENDLESS.items() if re.search(pattern, line)), "")
        output = folder / "output.txt"
        if marker:
            with running(shell(line, folder), env, output) as process:
                ready(process, output, marker)
                process.send_signal(signal.SIGINT)
                code = process.wait(60)
        else:
            with output.open("wb") as file:
                run = subprocess.run(["bash", "-c", line], cwd=folder, env=env, stdout=file, stderr=file, timeout=600)
            code = run.returncode
        permitted = next((codes for pattern, codes in OTHER_CODES.items() if re.search(pattern, line)), (0,))
        assert code in permitted, f"{page}: {line}: exit code {code}\n{output.read_text()}"


@pytest.mark.slow
def test_make_installs_the_package_into_an_environment_of_its_own(tmp_path):
    shutil.copytree(ROOT, tmp_path / "copy", ignore=shutil.ignore_patterns(".venv", ".git", "bags", "build", "install"))
    run = subprocess.run(["make", "venv"], cwd=tmp_path / "copy", capture_output=True, text=True)
    assert run.returncode == 0, f"{run.stdout}\n{run.stderr}"
