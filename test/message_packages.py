"""Message packages of drivers, which no registry has as wheels: generated and compiled from their definitions."""

import functools
import hashlib
import importlib.util
import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

DEFINITIONS = {
    "lbr_fri_idl": {
        "msg/LBRState.msg": """
            float64 sample_time
            int8 session_state
            int8 connection_quality
            int8 safety_state
            int8 operation_mode
            int8 drive_state
            int8 client_command_mode
            int8 overlay_type
            int8 control_mode
            uint32 time_stamp_sec
            uint32 time_stamp_nano_sec
            float64[7] measured_joint_position
            float64[7] commanded_joint_position
            float64[7] measured_torque
            float64[7] commanded_torque
            float64[7] external_torque
            float64[7] ipo_joint_position
            float64 tracking_performance""",
        "msg/LBRTorqueCommand.msg": """
            float64[7] joint_position
            float64[7] torque""",
    },
    "controller_manager_msgs": {
        "msg/ControllerState.msg": """
            string name
            string state
            string type
            string[] claimed_interfaces""",
        "srv/ListControllers.srv": """
            ---
            ControllerState[] controller""",
        "srv/SwitchController.srv": """
            string[] activate_controllers
            string[] deactivate_controllers
            int32 strictness
            int32 BEST_EFFORT=1
            int32 STRICT=2
            bool activate_asap
            builtin_interfaces/Duration timeout
            ---
            bool ok
            string message""",
        "srv/SetHardwareComponentState.srv": """
            string name
            lifecycle_msgs/State target_state
            ---
            bool ok
            lifecycle_msgs/State state""",
    },
    "franka_msgs": {
        "srv/SetFullCollisionBehavior.srv": """
            float64[7] lower_torque_thresholds_acceleration
            float64[7] upper_torque_thresholds_acceleration
            float64[7] lower_torque_thresholds_nominal
            float64[7] upper_torque_thresholds_nominal
            float64[6] lower_force_thresholds_acceleration
            float64[6] upper_force_thresholds_acceleration
            float64[6] lower_force_thresholds_nominal
            float64[6] upper_force_thresholds_nominal
            ---
            bool success
            string error""",
    },
}
"""What the tests need of each package, under the names and with the fields of the real ones."""
MISSING = {name: files for name, files in DEFINITIONS.items() if importlib.util.find_spec(name) is None}
"""Those that are not installed: asked before any test adds the folder with the built ones to where Python looks."""

_SUPPORTS = ("rosidl_typesupport_fastrtps_c", "rosidl_typesupport_introspection_c")
_PREFIX = Path(sys.prefix)


CACHE = Path(__file__).parents[1] / ".pytest_cache" / "message_packages"


def message_packages(cache=CACHE, numpy_headers=None):
    """A folder from which Python imports the packages, made once and kept in `cache`; () where all are installed.

    They are compiled against the headers of the NumPy at hand, or those in another folder. Skips the test where there
    is no compiler, or ROS is not that of the wheels.
    """
    if not MISSING:
        return ()
    if not (_PREFIX / "include" / "rosidl_runtime_c").is_dir():
        pytest.skip(f"{', '.join(MISSING)}: not installed, and no headers to build them with")
    if shutil.which("g++") is None or not Path(sysconfig.get_path("include"), "Python.h").is_file():
        pytest.skip("needs g++ and Python's headers")
    key = hashlib.sha256(f"{numpy_headers}{MISSING}{sys.version}{Path(__file__).read_text()}".encode()).hexdigest()[:16]
    folder = cache / key
    cache.mkdir(parents=True, exist_ok=True)
    if not folder.is_dir():
        with tempfile.TemporaryDirectory(dir=cache) as made:
            build = functools.partial(_build, Path(made) / "packages", numpy_headers or np.get_include())
            with ThreadPoolExecutor(2) as pool:
                list(pool.map(build, MISSING, MISSING.values()))
            try:
                os.rename(Path(made) / "packages", folder)
            except OSError:
                # Another process was faster.
                assert folder.is_dir()
    return (str(folder),)


def _build(folder, numpy_headers, name, files):
    package = folder / name
    package.mkdir(parents=True, exist_ok=True)
    for file, text in files.items():
        (package / file).parent.mkdir(exist_ok=True)
        (package / file).write_text("\n".join(line.strip() for line in text.split("\n")).lstrip())
    # Two of the generators give files the same names.
    beside = folder / "introspection" / name
    _generate(name, list(files), package, beside)
    headers = _PREFIX / "include"
    includes = [folder, beside.parent, sysconfig.get_path("include"), numpy_headers, headers, *headers.iterdir()]
    flags = [*(f"-I{each}" for each in includes), "-O0", "-w", "-fPIC", "-shared", f"-L{_PREFIX / 'lib'}"]
    flags += [f"-Wl,-rpath,{_PREFIX / 'lib'}:$ORIGIN:$ORIGIN/..", "-Wl,--no-as-needed"]
    fast, introspection = (folder / f"lib{name}__{support}.so" for support in _SUPPORTS)
    others = {line.split("/")[0] for text in files.values() for line in text.split() if "/" in line} | {"service_msgs"}
    libraries = [f"-l{other}__{part}" for other in sorted(others) for part in ("rosidl_generator_c", *_SUPPORTS)]
    libraries += ["-lrosidl_runtime_c", "-lrosidl_typesupport_c", "-lrcutils", "-lfastcdr"]
    libraries += ["-lrosidl_typesupport_fastrtps_cpp", *(f"-l{support}" for support in _SUPPORTS)]
    python = sorted(package.rglob("_*.c"))
    plain = sorted(set(package.rglob("*.c")) - set(python))
    both = ["-x", "c", *plain, "-x", "c++", *sorted(package.rglob("*.cpp")), "-x", "none"]
    _compile(fast, both, libraries, flags)
    _compile(introspection, sorted(beside.rglob("*.c")), [fast, *libraries], flags)
    module = package / f"{name}_s__rosidl_typesupport_c{sysconfig.get_config_var('EXT_SUFFIX')}"
    wrapped = [f"-l{other}__rosidl_generator_py" for other in sorted(others)]
    _compile(module, python, [fast, introspection, *libraries, *wrapped], flags)


def _generate(name, files, package, beside):
    lines = f"""
        from pathlib import Path
        from rosidl_generator_c.cli import GenerateC
        from rosidl_generator_py.cli import GeneratePython
        from rosidl_typesupport_c.cli import GenerateCTypesupport
        from rosidl_typesupport_fastrtps_c.cli import GenerateFastRTPSCTypesupport
        from rosidl_typesupport_introspection_c.cli import GenerateIntrospectionCTypesupport
        package, beside = Path({str(package)!r}), Path({str(beside)!r})
        beside.mkdir(parents=True)
        for generator, folder in (
            (GenerateC("c"), package),
            (GenerateCTypesupport("c"), package),
            (GenerateFastRTPSCTypesupport("c"), package),
            (GenerateIntrospectionCTypesupport("c"), beside),
            (GeneratePython("py", typesupport_implementations=["rosidl_typesupport_c"]), package),
        ):
            generator.generate({name!r}, {files!r}, [{str(_PREFIX / "share")!r}], folder)
    """
    code = "\n".join(line.removeprefix(" " * 8) for line in lines.split("\n"))
    env = {**os.environ, "AMENT_PREFIX_PATH": str(_PREFIX)}
    _run([sys.executable, "-c", code], cwd=package, env=env)


def _compile(target, sources, libraries, flags):
    _run(
        ["g++" if "c++" in sources else "gcc", f"-Wl,-soname,{target.name}", "-o", target, *sources, *flags, *libraries]
    )


def _run(command, **options):
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, **options)
    assert done.returncode == 0, done.stdout[-4000:]
