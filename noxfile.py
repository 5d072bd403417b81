"""Tests on each Python that this machine has.

`nox` runs all, `nox -s base-3.10` one of them (`nox -l` lists them). Python 3.11 to 3.13 run all tests.
Python 3.10 runs those for a robot's own computer (Ubuntu 22.04, Jetson): links, recording, safety, deployment
and the simulator. pip's own settings (PIP_EXTRA_INDEX_URL for PyTorch's CPU builds) apply.
"""

import nox

nox.options.error_on_missing_interpreters = False
nox.options.reuse_existing_virtualenvs = True


@nox.session(python=["3.10"])
def base(session: nox.Session) -> None:
    """Test all parts that need no torch."""
    session.install(
        "--constraint", "constraints-3.10.txt", "--editable", ".[robot,sim,keys,lerobot,dds,testing]"
    )
    others = ("gymnasium", "hypothesis", "onnx", "pillow", "pycdr2", "pytest-timeout", "pytest-xdist")
    session.install("--constraint", "constraints-3.10.txt", *others)
    folders = ("contracts", "control", "data", "drivers", "sim")
    session.run("pytest", "-n", "2", *(f"tests/{name}" for name in folders), *session.posargs)


@nox.session(python=["3.11", "3.12", "3.13"])
def full(session: nox.Session) -> None:
    """Test everything."""
    session.install("--constraint", "constraints.txt", "torch")
    session.install("--constraint", "constraints.txt", "--editable", ".[all,dev]")
    session.run("pytest", "-n", "2", *session.posargs)
