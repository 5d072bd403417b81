"""Feed damaged policies to the checks before a robot, and count the results.

Specs are damaged as JSON. An accepted spec runs the robot's behaviour in this process. Networks are damaged
as bytes. Most run in a fast worker, which is restarted after a crash or a hang. Some, and all that the worker
could not finish, run through the check of `deal-hw deploy`. A failure is any error that is not a refusal in
one line, a check beyond its time limit, or a gigabyte of memory here.

    .venv/bin/python tools/fuzz_policies.py --specs 100000 --networks 20000 --seed 1
"""

from __future__ import annotations

import argparse
import collections
import copy
import json
import random
import resource
import select
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from measuring import parser

from deal_hw.description import RobotDescription
from deal_hw.errors import PolicyError
from deal_hw.motions.behaviours import PolicyBehaviour
from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.policies.trial import TrialSettings, check_policy
from deal_hw.policies.trial_states import ProbeStates
from deal_hw.policy import Observation, PolicySpec
from deal_hw.robots import driver_description
from deal_hw.types import FloatArray
from deal_hw.workflows.shipped import shipped_policy

ROBOTS = ("cartpole", "go2")
MEMORY_BYTES = 2**30
SPEC_S = 5.0
"""Time limit of a spec [s]: one of 500 kB with 100,000 wrong entries takes two."""
NETWORK_S = 20.0
"""Time limit of a network in the worker, with its imports [s]."""
SETTINGS = TrialSettings(processor_s=5, nominal=2, random=5)
ODD: tuple[Any, ...] = (
    None,
    True,
    False,
    0,
    1,
    -1,
    10**9,
    10**400,
    0.0,
    -0.0,
    1e-320,
    1e300,
    float("nan"),
    float("inf"),
    float("-inf"),
    "",
    "1",
    "nan",
    "cart",
    "pole",
    "x",
    "z",
    "position",
    "velocity",
    "action",
    "gravity",
    "height",
    "command",
    "torque",
    "FL_hip_joint",
    "\x00",
    "\ud800",
    "x" * 10_000,
    [],
    {},
    [0.0],
    [[]],
    [None],
    {"a": 1},
    [1.0] * 2,
    [1.0] * 12,
    ["x"] * 300,
    ["cart", "pole"],
    [0.0] * 100_000,
)
OPERATORS = tuple(b"Relu Tanh Sqrt Ceil Sign Asin Acos Gemm Loop Size Cast".split())


class Still:
    """A policy that requests the default pose, and refuses observations that are not finite."""

    def __init__(self, spec: PolicySpec) -> None:
        self.spec = spec

    def reset(self) -> None:
        """The policy has no state."""

    def act(self, observation: Observation) -> FloatArray:
        """Return zeros."""
        if not np.isfinite(observation).all():
            raise PolicyError("an observation is not finite")
        return np.zeros(len(self.spec.actuated))


def places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Return the path of each value inside a JSON value."""
    inside = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [found for key, child in inside for found in ((*path, key), *places(child, (*path, key)))]


def damaged_spec(rng: random.Random, good: dict[str, Any], spots: list[tuple[Any, ...]]) -> str:
    """Return a spec's text with one to three damages."""
    values = copy.deepcopy(good)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        # Whole fields are damaged as often as the many entries of the observation.
        path = rng.choice(spots) if rng.random() < 0.5 else (rng.choice(list(good)),)
        place: Any = values
        try:
            for part in path[:-1]:
                place = place[part]
            how = rng.randrange(5)
            if how == 0:
                del place[path[-1]]
            elif how == 1 and isinstance(place, list):
                place.insert(rng.randrange(len(place) + 1), copy.deepcopy(rng.choice(place)))
            elif how == 2 and isinstance(place, dict):
                place["field" + str(rng.randrange(3))] = rng.choice(ODD)
            elif how == 3 and isinstance(place[path[-1]], float):
                place[path[-1]] *= rng.choice((-1, 0, 1.5, 1e3, 1e30, 57.3))
            else:
                place[path[-1]] = rng.choice(ODD)
        except (LookupError, TypeError):
            continue  # An earlier damage removed this value.
    text = json.dumps(values)
    if rng.random() < 0.05:
        at = rng.randrange(len(text))
        text = text[:at] + rng.choice(("", "[" * 5000, "\x00", "NaN", '"', "}", "1e999")) + text[at + 1 :]
    return text


def judge_spec(text: str, description: RobotDescription, probes: list[Any]) -> str:
    """Return the outcome of a spec; raises errors that are failures."""
    try:
        spec = PolicySpec.from_json(text)
        behaviour = PolicyBehaviour(Still(spec), description)
        behaviour.reset()
        with np.errstate(all="ignore"):
            for probe in probes:
                command = behaviour.command(probe.state, 0.0)
    except PolicyError as err:
        if "\n" in str(err) or len(str(err)) > 1000:
            raise ValueError(f"not one line: {err}") from err
        return f"refused ({type(err).__name__})"
    if PolicySpec.from_json(spec.to_json()) != spec:
        raise ValueError("does not survive JSON")
    for name in ("position_target", "stiffness", "damping", "effort_limit"):
        if not np.isfinite(getattr(command, name)).all():
            raise ValueError(f"{name} of the command is not finite")
    return "runs"


def fuzz_specs(count: int, seed: int) -> tuple[collections.Counter[str], list[str]]:
    """Return the outcomes of this number of specs, and the failures."""
    outcomes: collections.Counter[str] = collections.Counter()
    failures = []
    bases = []
    for robot in ROBOTS:
        description = driver_description(robot)
        states = ProbeStates(description)
        probes = [*states.nominal(1), *states.random(2, np.random.default_rng(0))]
        good = json.loads(OnnxPolicy(str(shipped_policy(robot))).spec.to_json())
        bases.append((good, places(good), description, probes))
    for number in range(count):
        rng = random.Random(f"{seed}/{number}")
        good, spots, description, probes = rng.choice(bases)
        text = damaged_spec(rng, good, spots)
        begun = time.perf_counter()
        try:
            outcomes[judge_spec(text, description, probes)] += 1
        except Exception as err:
            failures.append(f"spec {seed}/{number}: {type(err).__name__}: {str(err)[:200]}")
        if time.perf_counter() - begun > SPEC_S:
            failures.append(f"spec {seed}/{number}: took {time.perf_counter() - begun:.1f} s")
    return outcomes, failures


def damaged_network(seed: int, number: int) -> tuple[str, bytes]:
    """Return a robot and its shipped policy with damaged bytes."""
    rng = random.Random(f"network {seed}/{number}")
    robot = rng.choice(ROBOTS)
    data = bytearray(Path(str(shipped_policy(robot))).read_bytes())
    for _ in range(rng.choice((1, 1, 2, 4, 16))):
        # Graph and metadata are short and at both ends; the weights are between them.
        at = rng.choice(
            (
                rng.randrange(min(800, len(data))),
                -1 - rng.randrange(min(8000, len(data))),
                rng.randrange(len(data)),
            )
        ) % len(data)
        how = rng.randrange(6)
        if how == 0:
            data[at] ^= 1 << rng.randrange(8)
        elif how == 1:
            data[at] = rng.choice((0, 1, 0x7F, 0x80, 0xFF))
        elif how == 2:
            del data[at : at + rng.choice((1, 4, 100, 5000))]
        elif how == 3:
            data[at:at] = rng.randbytes(rng.choice((1, 4, 100)))
        elif how == 4:
            data[at : at + 4] = rng.choice((b"\xff\xff\xc0\x7f", b"\x00\x00\x80\x7f", b"\xff\xff\x7f\x7f"))
        else:
            found = data.find(rng.choice((b"Relu", b"Tanh", b"Gemm")))
            if found >= 0:
                data[found : found + 4] = rng.choice(OPERATORS)
        if len(data) < 8:
            break
    return robot, bytes(data)


def work(seed: int, first: int, last: int) -> None:
    """Judge networks in this process and print each outcome at once."""
    resource.setrlimit(resource.RLIMIT_AS, (4 * MEMORY_BYTES, resource.RLIM_INFINITY))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "policy.onnx"
        for number in range(first, last):
            robot, data = damaged_network(seed, number)
            path.write_bytes(data)
            try:
                policy = OnnxPolicy(path)
                policy.spec.check_fits(driver_description(robot))
                rng = np.random.default_rng(number)
                for _ in range(5):
                    policy.act(rng.standard_normal(len(policy.spec.observation)).astype(np.float32))
                outcome = "runs"
            except PolicyError as err:
                outcome = "refused" if "\n" not in str(err) else f"failure: two lines: {err!r}"
            except MemoryError:
                outcome = "refused (memory)"
            except Exception as err:
                outcome = f"failure: {type(err).__name__}: {str(err)[:200]!r}"
            print(outcome, flush=True)


def fuzz_networks(count: int, seed: int, every: int) -> tuple[collections.Counter[str], list[str]]:
    """Return the outcomes of this number of networks, and the failures."""
    outcomes: collections.Counter[str] = collections.Counter()
    failures: list[str] = []
    number = 0
    while number < count:
        command = [sys.executable, __file__, "--work", str(seed), str(number), str(count)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as worker:
            assert worker.stdout is not None
            while number < count:
                ready = select.select([worker.stdout], [], [], NETWORK_S)[0]
                # Unbuffered reads: a line is one short write.
                line = worker.stdout.readline().decode().strip() if ready else ""
                if not line:
                    line = "hangs the worker" if not ready else "crashes the worker"
                    worker.kill()
                outcomes[line if not line.startswith("failure") else "failure"] += 1
                if line.startswith("failure"):
                    failures.append(f"network {seed}/{number}: {line}")
                if number % every == 0 or "worker" in line:
                    outcome = judge_network(seed, number)
                    outcomes[f"whole check: {outcome.partition(':')[0]}"] += 1
                    if outcome.startswith("failure"):
                        failures.append(f"network {seed}/{number}: {outcome}")
                number += 1
                if "worker" in line:
                    break
    return outcomes, failures


def judge_network(seed: int, number: int) -> str:
    """Return the result of `deal-hw deploy`'s check for a network."""
    robot, data = damaged_network(seed, number)
    begun = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "policy.onnx"
        path.write_bytes(data)
        try:
            check_policy(path, driver_description(robot), SETTINGS)
            outcome = "runs"
        except PolicyError as err:
            outcome = "refused" if "\n" not in str(err) else f"failure: two lines: {err!r}"
        except Exception as err:
            outcome = f"failure: {type(err).__name__}: {str(err)[:200]!r}"
    took = time.perf_counter() - begun
    return outcome if took < SETTINGS.time_limit_s + 1.0 else f"failure: took {took:.1f} s"


def main() -> int:
    """Print the table; return 1 where anything failed."""
    options = parser(__doc__, out=False)
    options.add_argument("--specs", type=int, default=10_000)
    options.add_argument("--networks", type=int, default=1_000)
    options.add_argument("--every", type=int, default=50, help="1 of N networks gets the whole check")
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--work", type=int, nargs=3, default=None, help=argparse.SUPPRESS)
    given = options.parse_args()
    if given.work is not None:
        work(*given.work)
        return 0
    failures: list[str] = []
    parts: tuple[tuple[str, Callable[[], tuple[collections.Counter[str], list[str]]]], ...] = (
        ("specs", lambda: fuzz_specs(given.specs, given.seed)),
        ("networks", lambda: fuzz_networks(given.networks, given.seed, given.every)),
    )
    for what, run in parts:
        begun = time.perf_counter()
        outcomes, wrong = run()
        failures += wrong
        print(f"{what} in {time.perf_counter() - begun:.0f} s:")
        for outcome, times in outcomes.most_common():
            print(f"  {times:7} {outcome}")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    if peak > MEMORY_BYTES:
        failures.append(f"this process took {peak / 2**20:.0f} MiB")
    print(f"memory of this process: {peak / 2**20:.0f} MiB; failures: {len(failures)}")
    print("\n".join(failures[:20]))
    return int(bool(failures))


if __name__ == "__main__":
    sys.exit(main())
