"""What a source of recordings yields, before anything is aligned or divided."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from deal_hw.parameters import ParameterSpace
from deal_hw.types import Trajectory

if TYPE_CHECKING:
    from deal_hw.calib.data.population_policy import PopulationPolicy
    from deal_hw.motions.behaviours import Behaviour
    from deal_hw.sim.engine.model import RobotModel
    from deal_hw.sim.mjcf.describe import Sampling
    from deal_hw.sim.recordings.setups import Setups


@dataclass(frozen=True, slots=True)
class Named:
    """A recording.

    Attributes:
        name: Its name in messages.
        trajectory: Its data.
        rates: Its own grid; None: that of the robot's description.
    """

    name: str
    trajectory: Trajectory
    rates: Sampling | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Division:
    """How recordings become parts to fit and parts that judge.

    Attributes:
        share: Share of each fitted recording, its last part, that is held out as well.
        fit_seconds: How much to fit, spread evenly over the recordings [s].
        window_s: Length of a search's longest windows [s].
    """

    share: float
    fit_seconds: float
    window_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """Checked recordings of one robot, with its model and its parameters.

    Attributes:
        robot: The nominal model; its physics steps suit the recordings.
        space: The parameters to search.
        fitted: Recordings to fit.
        held: Recordings that only judge the result.
        division: How parts are chosen; None for a robot with a driver, whose recordings are used whole.
        sample_hz: Fitted samples per second [Hz]; None: all.
        feet: Sphere geoms of the feet of a floating robot.
        telemetry: Verdicts on the recordings, for the report.
        provenance: Where all this comes from: plain JSON values.
        advice: How to get a held-out recording if there is none.
        balance: Makes the policy that balances the robot in advised motions; None: it stands by itself.
        name: Name under which `deal-hw collect` records this robot; "" if it cannot.
        policy: The policy that moved the robot all the time, if the method needs it.
        setups: Which recordings were made with a change of the robot; None: all with the model itself.
        rates: The grid that the robot's description has; None: that of a robot with a driver.
    """

    robot: RobotModel
    space: ParameterSpace
    fitted: Sequence[Named]
    held: Sequence[Named]
    division: Division | None
    sample_hz: float | None
    feet: tuple[str, ...]
    telemetry: Sequence[str]
    provenance: Mapping[str, Any]
    advice: str
    balance: Callable[[], Behaviour] | None = None
    name: str = ""
    policy: PopulationPolicy | None = None
    setups: Setups | None = None
    rates: Sampling | None = None
