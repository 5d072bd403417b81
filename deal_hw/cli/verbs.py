"""The table of verbs.

A verb is a module of this package that holds a frozen dataclass of settings and a function that takes it. The
table names them as text, and only the requested verb is imported. This keeps `deal-hw --help` fast, and
`collect` never loads the packages of `train`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType


@dataclass(frozen=True, slots=True, kw_only=True)
class Verb:
    """One verb of the command.

    A verb whose options depend on its input has *kinds*. ``config`` then names a ``Kinds`` in its module:

    - Its ``table`` returns kind word -> ``InputKind(settings, help, example=...)``; the settings are a frozen
      dataclass that has only the options that apply, and the example stands in the help of that kind. Share
      options by inheritance, or by groups: a field whose type is another dataclass, with a default factory.
      Its options need no prefix on the command line.
    - Its ``find`` returns the kind word from :class:`~deal_hw.workflows.kinds.Arguments`, where the first
      argument alone is none, such as for a path or for ``--model``.
    - ``argument`` is the field that takes the first argument; without it the word only names the kind, as in
      ``deal-hw data info`` (see :func:`~deal_hw.workflows.kinds.sub_verbs`).
    - ``kinds.with_options(Quiet)`` adds what only the command line has.

    The function of Python takes the same kinds: ``@from_settings(KINDS)``. Both refuse an option of another
    kind and say which kinds have it. A field is an argument without a name if it is not keyword-only. A
    field marked ``Annotated[..., FROM_PYTHON]`` is no option. ``deal-hw VERB --help`` lists the kinds,
    ``deal-hw VERB KIND --help`` the options of one.

    Attributes:
        module: The module that does it.
        config: Its settings: a frozen dataclass, or a :class:`~deal_hw.workflows.kinds.Kinds` where the
            options depend on the robot, the bench, the kind of input, or a sub-verb.
        function: Called with the settings; returns an exit code, or a report, which may have an `exit_code`.
        help: One line.
        example: Working arguments, as `deal-hw --help` shows them.
        extra: The extra that installs the verb's packages; "" for the base install.
        common: Settings that --help explains; all where empty. --help-all explains all.
        urgent: Whether a simple command line is read without the parser, which takes 0.2 s to load.
    """

    module: str
    config: str
    function: str
    help: str
    example: str
    extra: str = ""
    common: tuple[str, ...] = ()
    urgent: bool = False


def _verb(
    name: str,
    *,
    help: str,
    example: str,
    extra: str = "",
    module: str = "",
    function: str = "",
    config: str = "",
    common: str = "",
    urgent: bool = False,
) -> Verb:
    plain = name.replace("-", "_")
    return Verb(
        module=f"deal_hw.cli.{module or plain}",
        config=config or "".join(part.capitalize() for part in name.split("-")),
        function=function or plain,
        help=help,
        example=example,
        extra=extra,
        common=tuple(common.split()),
        urgent=urgent,
    )


JOBS: Mapping[str, Verb] = MappingProxyType(
    {
        "collect": _verb(
            "collect",
            help="record the robot during an informative motion",
            config="KINDS",
            example="collect cartpole --port /dev/ttyUSB0 --out runs/first",
            function="collect_and_say_next",
            common="port out motion policy seconds transport velocity stand hung_on_crane quiet",
        ),
        "calibrate": _verb(
            "calibrate",
            help="find the simulator parameters that explain recordings of any robot (--model)",
            example="calibrate runs/first/dataset",
            extra="calib",
            config="KINDS",
            function="calibrate_or_write_parameters",
            common="model data columns parameters write_parameters episodes holdout leave_out method "
            "search known space out resume json quiet",
        ),
        "train": _verb(
            "train",
            help="train a policy under the calibrated distribution",
            config="KINDS",
            example="train cartpole --distribution runs/first/calibration/distribution.json --out runs/first",
            extra="train",
            function="train_and_say_next",
            common="distribution udr nominal env out start resume steps quiet",
        ),
        "deploy": _verb(
            "deploy",
            help="run a policy on the robot behind the safety filter",
            config="KINDS",
            example="deploy cartpole --port /dev/ttyUSB0 --policy runs/first/policies/policy.onnx",
            extra="deploy",
            common="port out policy seconds task transport velocity stand hung_on_crane trust_calibration "
            "dry_run quiet",
        ),
        "inspect": _verb(
            "inspect",
            module="inspect_",
            help="see the real, the nominal and the calibrated motion on one screen",
            example="inspect runs/first/dataset/episodes/000000.mcap --calibration runs/first/calibration",
            extra="sim,viz",
        ),
    }
)
"""The five jobs, in the order of the loop."""

TOOLS: Mapping[str, Verb] = MappingProxyType(
    {
        "demo": _verb(
            "demo",
            help="do all five jobs on an emulated cart-pole or Go2",
            config="KINDS",
            example="demo --out runs/demo",
            extra="all",
        ),
        "design-excitation": _verb(
            "design-excitation",
            help="compute the most informative motion to play on a robot",
            config="KINDS",
            example="design-excitation cartpole --out runs/first/excitation.json",
            extra="calib",
        ),
        "emulate": _verb(
            "emulate",
            help="emulate a robot on its own port, with hidden physics",
            config="KINDS",
            example="emulate cartpole --profile realistic --seed 0",
            extra="sim",
        ),
        "bridge": _verb(
            "bridge",
            help="on the Go2's computer: connect DDS and Zenoh, admit one controller, damp the robot "
            "without one",
            example="bridge go2 --port eth0",
            extra="dds,zenoh",
        ),
        "keys": _verb(
            "keys",
            help="make certificates for the bridge and its clients, and show how long they are valid",
            config="KINDS",
            example="keys make --out keys --robot 192.168.1.20",
            extra="keys",
        ),
        "robot": _verb(
            "robot",
            help="describe your own robot (robot.yaml, made from its MJCF), and check the description",
            config="KINDS",
            example="robot new robot.xml",
            extra="sim",
        ),
        "policy": _verb(
            "policy",
            help="import a policy that mjlab, unitree_rl_lab or unitree_rl_gym trained; show, check policies",
            config="KINDS",
            example="policy import exported/policy.onnx --robot go2 --out walk.onnx",
            extra="train",
        ),
        "data": _verb(
            "data",
            help="show, verify and repair datasets; keep and remove episodes; import and export recordings",
            config="KINDS",
            example="data info runs/first/dataset",
            extra="sim",
        ),
        "replay": _verb(
            "replay",
            help="send a recording's commands again, through the safety filter",
            config="KINDS",
            example="replay runs/first/dataset/episodes/000000.mcap --port /dev/ttyUSB0",
        ),
        "stop": _verb(
            "stop",
            help="make a robot passive at once, from any terminal, whoever of deal-hw commands it",
            config="KINDS",
            example="stop go2",
            urgent=True,
        ),
        "doctor": _verb(
            "doctor",
            help="check this computer, the connection and the robot",
            config="KINDS",
            example="doctor go2 --port enp2s0",
        ),
        "bench": _verb(
            "bench",
            help="measure how well calibration and the whole loop work, as JSON rows",
            config="KINDS",
            example="bench loop --profile sensor --seeds 0,1 --out loop.json",
            extra="bench",
        ),
    }
)
"""The verbs beside the five jobs."""

VERBS: Mapping[str, Verb] = MappingProxyType({**JOBS, **TOOLS})
