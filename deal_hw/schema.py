"""Reads JSON into dataclasses and names wrong fields; writes dataclasses as plain JSON values.

pydantic checks types, missing and unknown fields by the dataclass's annotations. Checks in its
``__post_init__``, which also hold in Python, cover ranges and relations of fields. pydantic is imported on
use, so that `import deal_hw` stays fast.
"""

from __future__ import annotations

import dataclasses
import enum
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, Final, TypeVar

from deal_hw.errors import SHORT, ConfigurationError, short, shown

if TYPE_CHECKING:
    from pydantic import GetCoreSchemaHandler, TypeAdapter, ValidationError

T = TypeVar("T")

STRICT: Final[Mapping[str, Any]] = MappingProxyType({"strict": True, "extra": "forbid"})
"""Value of ``__pydantic_config__`` in a dataclass: nothing is converted, unknown fields are refused."""
FINITE: Final[Mapping[str, Any]] = MappingProxyType({**STRICT, "allow_inf_nan": False})
"""As :data:`STRICT`, and all numbers are finite."""
OPEN: Final[Mapping[str, Any]] = MappingProxyType({"strict": True})
"""As :data:`STRICT`, but unknown fields are ignored."""
OPEN_FINITE: Final[Mapping[str, Any]] = MappingProxyType({**OPEN, "allow_inf_nan": False})
"""As :data:`OPEN`, and all numbers are finite."""
SHOWN: Final = 3
"""Number of wrong fields that a message explains; it counts or names the rest."""
_MAX_NAMES: Final = 16


def read_json(kind: type[T], text: str | bytes) -> T:
    """Return the dataclass, or plain values, that a JSON text describes.

    Raises:
        ConfigurationError: The text is no JSON, or a field is wrong; the message names the fields.
    """
    from pydantic import ValidationError

    try:
        made: T = _adapter(kind).validate_json(text)  # type: ignore[arg-type]  # Classes are hashable.
    except ValidationError as err:
        raise ConfigurationError(_explain(err)) from err
    return made


def from_values(kind: type[T], values: Any) -> T:
    """Return the dataclass that plain JSON values describe; errors as :func:`read_json`."""
    try:
        text = json.dumps(values)
    except (TypeError, ValueError, RecursionError) as err:
        raise ConfigurationError(f"not plain JSON values: {err}") from err
    return read_json(kind, text)


def plain(value: Any, *, finite: bool = True) -> Any:
    """Return a dataclass, an array or a container of such as plain JSON values.

    Enumerations are written by their values, paths as text, tuples and arrays as lists.

    Args:
        value: What to write.
        finite: Whether a number that is not finite becomes None, as JSON has none.
    """
    if isinstance(value, enum.Enum):
        return value.value
    if isinstance(value, float):
        return value if math.isfinite(value) or not finite else None
    if isinstance(value, Path):
        return str(value)
    if dataclasses.is_dataclass(value):
        entries = dataclasses.fields(value)
        return {entry.name: plain(getattr(value, entry.name), finite=finite) for entry in entries}
    if isinstance(value, Mapping):
        return {key: plain(part, finite=finite) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [plain(part, finite=finite) for part in value]
    return plain(value.tolist(), finite=finite) if hasattr(value, "tolist") else value


@dataclass(frozen=True, slots=True)
class Tagged:
    """Annotation of a union of dataclasses; a field of each, a ``Literal``, names its class."""

    field: str

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> Any:
        from pydantic import Field

        return handler.generate_schema(Annotated[source, Field(discriminator=self.field)])


@cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    from pydantic import TypeAdapter

    return TypeAdapter(kind)


def _explain(err: ValidationError) -> str:
    """Return a line for each wrong field, with its value and the allowed ones."""
    errors = err.errors(include_url=False)
    found = []
    for error in errors[:SHOWN]:
        parts = [f"[{part}]" if isinstance(part, int) else f".{short(part, SHORT)}" for part in error["loc"]]
        place = "".join(parts).lstrip(".")
        if error["type"] == "value_error":
            # A check of a dataclass, which does not know its place in the file.
            found.append(": ".join(filter(None, (place, str(error["ctx"]["error"])))))
        elif not place or error["type"] == "missing":
            found.append(f"field {place} is missing" if place else error["msg"])
        else:
            found.append(f"field {place} is {shown(error['input'])}; {error['msg']}")
    more = f"; and {len(errors) - SHOWN} more" if len(errors) > SHOWN else ""
    return "; ".join(found) + more


def refusal(name: str, found: object, allowed: str, *, quote: bool = True) -> ConfigurationError:
    """Return the error that names a field, its value and the allowed ones."""
    return ConfigurationError(f"field {name} is {shown(found) if quote else found}; allowed: {allowed}")


def either(allowed: Sequence[str]) -> str:
    """Return a message's list of names; of many names only the first."""
    text = ", ".join(shown(name) for name in allowed[:_MAX_NAMES])
    return text if len(allowed) <= _MAX_NAMES else f"{text}, ... ({len(allowed)} in all)"


def check_members(name: str, values: Sequence[str], known: Sequence[str]) -> None:
    """Check that each value is one of the known ones.

    Raises:
        ConfigurationError: A value is unknown.
    """
    for i, value in enumerate(values):
        if value not in known:
            raise refusal(f"{name}[{i}]", value, either(known))


def check_numbers(
    name: str, values: Sequence[float], length: int, *, lowest: float = -math.inf, endless: bool = False
) -> None:
    """Check that there are ``length`` numbers, each finite and not too small.

    Args:
        name: Name of the field.
        values: Its values.
        length: Required number of values.
        lowest: Smallest allowed value.
        endless: Whether infinity is allowed, too.

    Raises:
        ConfigurationError: A check failed.
    """
    if len(values) != length:
        raise refusal(name, f"of length {len(values)}", f"{length}", quote=False)
    for i, value in enumerate(values):
        if not ((math.isfinite(value) and value >= lowest) or (endless and value == math.inf)):
            at_least = "" if lowest == -math.inf else f" of at least {lowest:g}"
            raise refusal(f"{name}[{i}]", value, f"a finite number{at_least}")
