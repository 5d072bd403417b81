"""The wheel holds the package and nothing else, and its base loads without the extras."""

from __future__ import annotations

import functools
import importlib.metadata
import json
import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import tomllib

from deal_hw.sim.robots.robot_file import ActuatorEntry, JointEntry, RobotFile, write_robot_file

ROOT = Path(__file__).resolve().parents[2]
LEAVES = ("calib", "drivers", "policies")
FOLDERS = ("deal_hw", *LEAVES)

BASE_FOLDERS = (
    "deal_hw",
    "deal_hw/control",
    "deal_hw/control/loop",
    "deal_hw/control/process",
    "deal_hw/control/safety",
    "deal_hw/motions",
    "deal_hw/motions/excitation",
    "deal_hw/motions/scores",
    "deal_hw/data",
    "deal_hw/data/checks",
    "deal_hw/data/export",
    "deal_hw/data/importing",
    "deal_hw/data/recording",
    "drivers/transports",
)
BASE_MODULES = (
    "deal_hw.cli.main",
    "deal_hw.cli.bridge",
    "deal_hw.cli.collect",
    "deal_hw.cli.data",
    "deal_hw.cli.deploy",
    "deal_hw.cli.doctor",
    "deal_hw.cli.keys",
    "deal_hw.cli.replay",
    "deal_hw.drivers",
    "deal_hw.drivers.cartpole.description",
    "deal_hw.drivers.cartpole.wire.protocol",
    "deal_hw.drivers.cartpole.robots.robot",
    "deal_hw.drivers.cartpole.robots.can_robot",
    "deal_hw.drivers.transports.slcan_transport",
    "deal_hw.drivers.go2.doctor",
    "deal_hw.drivers.go2.descriptions.driver",
    "deal_hw.drivers.go2.descriptions.on_stand",
    "deal_hw.drivers.go2.robot",
)
EXTRAS = (
    "torch",
    "mujoco",
    "scipy",
    "rerun",
    "gymnasium",
    "stable_baselines3",
    "onnx",
    "onnxscript",
    "matplotlib",
    "pytest",
    "hypothesis",
    "cryptography",
    "cyclonedds",
    "zenoh",
    "can",
    "cantools",
    "dynamixel_sdk",
    "dynamixel_easy_sdk",
    "onnxruntime",
)

IMPORT_BASE = """
import importlib, json, sys

class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in EXTRAS:
            raise ModuleNotFoundError(f"{name} belongs to an extra", name=name)

sys.meta_path.insert(0, Refuse())
where = {}
for name in MODULES:
    where[name] = importlib.import_module(name).__file__
print(json.dumps(where))
"""


def project() -> dict[str, object]:
    """Return the contents of pyproject.toml."""
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def package_of(path: Path) -> str:
    """Return the package name of a folder of the repository."""
    parts = path.relative_to(ROOT).parts
    return ".".join(("deal_hw", *parts) if parts[0] in LEAVES else parts)


def packages_in_tree() -> dict[str, Path]:
    """Return every folder that holds Python sources, by package name."""
    sources = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")]
    return {package_of(path.parent): path.parent for path in sources}


def data_in_tree() -> set[str]:
    """Return the files of the packages that are not Python sources, by their path in the wheel."""
    found = set()
    for folder in FOLDERS:
        for path in (ROOT / folder).rglob("*"):
            if path.is_file() and path.suffix not in {".py", ".pyc"} and not path.name.startswith("."):
                inside = path.relative_to(ROOT)
                found.add(str(inside if folder == "deal_hw" else Path("deal_hw") / inside))
    return found | {f"deal_hw/{path.relative_to(ROOT)}" for path in (ROOT / "docs").rglob("*.md")}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the wheel from a copy, since setuptools leaves files in the tree that later builds pick up."""
    source = tmp_path_factory.mktemp("source")
    for folder in (*FOLDERS, "docs"):
        shutil.copytree(ROOT / folder, source / folder, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    build = "import setuptools.build_meta as backend, sys; backend.build_wheel(sys.argv[1])"
    target = tmp_path_factory.mktemp("wheel")
    subprocess.run(
        [sys.executable, "-c", build, str(target)], cwd=source, check=True, capture_output=True, timeout=120
    )
    (path,) = target.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def unpacked(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Unpack the wheel into a folder of its own, as an install would."""
    target = tmp_path_factory.mktemp("site")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(target)
    return target


def run_elsewhere(code: str, unpacked: Path, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run Python code outside the repository with the unpacked wheel before everything that is installed."""
    environment = {**os.environ, "PYTHONPATH": str(unpacked), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-W", "error", "-c", code]
    return subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=120)


def test_packages_are_all_listed_and_mapped() -> None:
    """The list and the mapping in pyproject.toml name exactly the packages of the tree, and the pages."""
    setuptools = project()["tool"]["setuptools"]  # type: ignore[index]
    tree = {**packages_in_tree(), "deal_hw.docs": ROOT / "docs"}
    assert sorted(setuptools["packages"]) == sorted(tree)
    mapping = setuptools["package-dir"]
    for name, folder in tree.items():
        top, _, rest = name.partition(".")
        mapped = mapping.get(name, f"{mapping[top]}/{rest.replace('.', '/')}")
        assert ROOT / mapped == folder


def test_packages_have_a_docstring_file() -> None:
    """Each package has an `__init__.py`, so that a checkout and an installed wheel find the same."""
    missing = [name for name, folder in packages_in_tree().items() if not (folder / "__init__.py").is_file()]
    assert missing == []


@pytest.mark.parametrize("leaf", LEAVES)
def test_mapped_names_are_not_shadowed(leaf: str) -> None:
    """No file or folder of `deal_hw/` takes the name of a mapped package."""
    assert not (ROOT / "deal_hw" / leaf).exists()
    assert not (ROOT / "deal_hw" / f"{leaf}.py").exists()


def test_tests_are_no_package() -> None:
    """A `tests/__init__.py` would put the root on the path, where `drivers` imports as a second copy."""
    assert list((ROOT / "tests").rglob("__init__.py")) == []


def test_test_files_have_unique_names() -> None:
    """Two test files of one name cannot be distinguished in a report."""
    names = [path.name for path in (ROOT / "tests").rglob("test_*.py")]
    assert sorted(set(names)) == sorted(names)


def test_wheel_holds_the_package_and_nothing_else(wheel: Path) -> None:
    """All sources, assets and the licence are in it, under `deal_hw/`."""
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    metadata = {name for name in names if name.startswith("deal_hw-")}
    sources = {
        f"{package.replace('.', '/')}/{path.name}"
        for package, folder in packages_in_tree().items()
        for path in folder.glob("*.py")
    }
    scripts = set(project()["tool"]["setuptools"]["script-files"])  # type: ignore[index]
    assert names - metadata == (sources | data_in_tree()) - scripts
    assert {Path(name).name for name in metadata if ".data/scripts/" in name} == {
        Path(script).name for script in scripts
    }
    assert "deal_hw/py.typed" in names
    assert any(name.endswith("licenses/LICENSE") for name in metadata)


def test_base_install_loads_without_extras(unpacked: Path, tmp_path: Path) -> None:
    """Contracts, control, recording, drivers and the verbs of the robot's own computer need no extra."""
    files = [
        path for folder in BASE_FOLDERS for path in (ROOT / folder).glob("*.py") if path.stem != "__init__"
    ]
    modules = sorted({*BASE_MODULES, *(f"{package_of(path.parent)}.{path.stem}" for path in files)})
    code = f"EXTRAS = {EXTRAS!r}\nMODULES = {modules!r}\n{IMPORT_BASE}"
    done = run_elsewhere(code, unpacked, tmp_path)
    assert done.returncode == 0, done.stderr
    where = json.loads(done.stdout)
    assert all(Path(file).is_relative_to(unpacked) for file in where.values())


def test_command_runs_from_the_wheel(unpacked: Path, tmp_path: Path) -> None:
    """`python -m deal_hw` works outside the repository and tells the version that the wheel has."""
    code = "import sys, runpy; sys.argv[1:] = ['--version']; runpy.run_module('deal_hw', run_name='__main__')"
    done = run_elsewhere(code, unpacked, tmp_path)
    assert done.stdout == f"deal-hw {project()['project']['version']}\n"  # type: ignore[index]
    assert done.returncode == 0


def test_a_message_of_the_wheel_names_a_page_that_can_be_opened(unpacked: Path, tmp_path: Path) -> None:
    """Outside the repository a refusal names the page of the installed package by its full path."""
    joint = JointEntry(name="hinge", unit="rad", actuator=ActuatorEntry())
    robot = RobotFile(
        version=1,
        name="mine",
        mjcf="mine.xml",
        actuation="position",
        control_rate_hz=50.0,
        state_rate_hz=50.0,
        joints=(joint,),
    )
    (tmp_path / "robot.yaml").write_text(write_robot_file(robot), encoding="utf-8")
    words = ["deploy", "robot.yaml", "--port", "p"]
    code = f"import sys; from deal_hw.cli.main import main; sys.exit(main({words}))"
    done = run_elsewhere(code, unpacked, tmp_path)
    assert done.returncode == 2, done.stderr
    (named,) = re.findall(r"(/\S+\.md)", done.stderr)
    assert Path(named) == unpacked / "deal_hw/docs/reference/robot-file.md" and Path(named).is_file()


@pytest.mark.slow
def test_the_wheel_calibrates_a_robot_in_a_clean_environment(wheel: Path, tmp_path: Path) -> None:
    """Installed by pip beside the packages that it names: a model and a recording give a calibrated one."""
    from deal_hw.testing.plain_robots import make_robot, write

    where = tmp_path / "clean"
    made = [sys.executable, "-m", "venv", "--without-pip", str(where)]
    subprocess.run(made, check=True, capture_output=True, timeout=120)
    (site,) = where.glob("lib/python*/site-packages")
    # Paths in a .pth file are searched; .pth files there are not read, so the editable install is hidden.
    packages = [path for path in sys.path if Path(path).name == "site-packages"]
    (site / "packages.pth").write_text("\n".join(packages), encoding="utf-8")
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "VIRTUAL_ENV", "COV"))}
    run = functools.partial(
        subprocess.run, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300
    )
    # Our pip installs there; a second one would take as long as all the rest.
    pip = [sys.executable, "-m", "pip", "--python", where / "bin" / "python"]
    done = run([*pip, "install", "--no-index", "--no-deps", wheel])
    assert done.returncode == 0, done.stderr
    model, (recording, *_), other = write(make_robot("pendulum", seed=0), tmp_path / "robot", seconds=3.0)
    done = run(
        [
            where / "bin" / "deal-hw",
            "calibrate",
            "--model",
            model,
            "--data",
            recording,
            "--holdout",
            other,
            "--out",
            "found",
            "--threads",
            "1",
        ]
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert [path.name for path in (tmp_path / "found").rglob("calibrated.xml")]
    line = "import deal_hw; print(deal_hw.__file__)"
    reported = run([where / "bin" / "python", "-c", line]).stdout.strip()
    assert Path(reported).is_relative_to(site)


def test_versions_agree() -> None:
    """The package and pyproject.toml name the same version."""
    from deal_hw import __version__

    assert project()["project"]["version"] == __version__  # type: ignore[index]


def test_the_extra_robot_is_the_four_of_a_robots_computer() -> None:
    """Wires and the policy's runtime have extras; `robot` and `all` have these, the base install has none."""
    extras = project()["project"]["optional-dependencies"]  # type: ignore[index]
    wanted = {re.split("[><=;]", entry)[0] for entry in project()["project"]["dependencies"]}  # type: ignore[index]
    parts = {
        "can": "python-can",
        "dynamixel": "dynamixel-sdk",
        "zenoh": "eclipse-zenoh",
        "deploy": "onnxruntime",
    }
    assert extras["robot"] == [f"deal-hw[{','.join(parts)}]"]
    assert all(extras[extra][0].startswith(package) for extra, package in parts.items())
    assert not wanted & {*parts.values(), "cantools"}
    assert "robot" in re.split(r"[\[\],]", extras["all"][0])


def test_the_can_wires_of_the_cart_pole_are_small() -> None:
    """python-can, cantools and what they need take less than 15 MB (measured: 5.5 MB)."""
    named = {"python-can", "cantools", "bitstruct", "crccheck", "textparser", "argparse-addons", "wrapt"}
    sizes = {}
    for name in named:
        files = importlib.metadata.distribution(name).files or []
        paths = [Path(str(file.locate())) for file in files]
        sizes[name] = sum(path.stat().st_size for path in paths if path.is_file())
    assert all(sizes.values())
    assert sum(sizes.values()) < 15e6, sizes
