"""Contract of a transport: a path for bytes or messages."""

from __future__ import annotations

import abc
import io
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, ClassVar

from typing_extensions import Self

from deal_hw.errors import ConfigurationError
from deal_hw.schema import OPEN, from_values, plain


@dataclass(frozen=True, slots=True)
class Message:
    """Bytes with their channel.

    Attributes:
        channel: CAN id, topic or key; "" for a byte stream.
        payload: The bytes.
        stamp_ns: Host clock at reception or sending [ns].
        attachment: Further bytes beside the payload, if the path supports them (Zenoh); b"" for none.
    """

    channel: str
    payload: bytes
    stamp_ns: int
    attachment: bytes = b""


class Transport(abc.ABC):
    """A path for bytes or messages. The constructor does no I/O; ``open`` and ``close`` are idempotent.

    Attributes:
        can_send: Whether :meth:`send` may be called at all; False for a path that only listens.
    """

    can_send: bool = True

    @abc.abstractmethod
    def open(self) -> None:
        """Open the path.

        Raises:
            PortNotFoundError: There is no such port.
            PortBusyError: Another program holds it.
        """

    @abc.abstractmethod
    def close(self) -> None:
        """Close the path."""

    def reopen(self) -> None:
        """Open the path again after it was lost. An intact path may stay unchanged.

        Raises:
            TransportError: It cannot be opened now; a later attempt may succeed.
        """
        self.close()
        self.open()

    @abc.abstractmethod
    def send(self, message: Message) -> None:
        """Send at once, without waiting for the peer.

        Raises:
            TransportLostError: The peer vanished.
            TransportTimeoutError: The path takes no more bytes.
        """

    @abc.abstractmethod
    def receive(self, timeout_s: float) -> Message:
        """Return what arrived; for a byte stream, all waiting bytes (at least one).

        Args:
            timeout_s: How long to wait for the first byte [s]; 0 polls.

        Raises:
            TransportTimeoutError: Nothing arrived in time.
            TransportLostError: The peer vanished.
        """

    def fileno(self) -> int:
        """Return the descriptor of the open path, which a child process can inherit; -1: each opens its own.

        Raises:
            UnsupportedOperation: The path has none.
        """
        raise io.UnsupportedOperation(f"{type(self).__name__} has no file descriptor")

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class TransportWrapper(Transport):
    """A transport on top of another, which it opens and closes; the subclass handles the data.

    Args:
        inner: The transport below.
    """

    def __init__(self, inner: Transport) -> None:
        self._inner = inner

    @property
    def port(self) -> str:
        """The port of the path."""
        return str(getattr(self._inner, "port", type(self._inner).__name__))

    def open(self) -> None:
        """Open the path."""
        self._inner.open()

    def close(self) -> None:
        """Close the path."""
        self._inner.close()

    def reopen(self) -> None:
        """Open the path again."""
        self._inner.reopen()

    def receive(self, timeout_s: float) -> Message:
        """Return what arrived."""
        return self._inner.receive(timeout_s)

    def fileno(self) -> int:
        """Return the descriptor of the path."""
        return self._inner.fileno()


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworkOptions:
    """What both sides of a topic transport say of the network."""

    __pydantic_config__: ClassVar[Mapping[str, Any]] = OPEN

    domain: int = 0
    """Number of the DDS domain."""
    insecure: bool = False
    """Allow plain TCP to another machine (zenoh)."""
    ca: Path | None = None
    """Authority that signed the peers' certificates (PEM)."""
    certificate: Path | None = None
    """This side's certificate (PEM), which the peer checks."""
    key: Path | None = None
    """Private key of the certificate (PEM)."""

    def __post_init__(self) -> None:
        if not 0 <= self.domain <= 232:
            raise ConfigurationError(f"DDS domain {self.domain}: allowed are 0 to 232")
        if (self.certificate is None) != (self.key is None):
            raise ConfigurationError(
                "a certificate and its private key belong together: give both or neither"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class WireOptions(NetworkOptions):
    """How a topic transport reaches its peers, beyond the port."""

    listen: bool = False
    """Wait for peers at the port instead of connecting to them (zenoh)."""
    mode: str = ""
    """Zenoh session mode, peer or client; by default peer with --listen, else client. Two clients of one
    listener receive each other's messages. Two peers do not, so another program's commands would stay
    unnoticed."""

    def __post_init__(self) -> None:
        # Not super(): a slotted dataclass is another class than the one of this method.
        NetworkOptions.__post_init__(self)
        if self.mode not in ("", "peer", "client"):
            raise ConfigurationError(f"wire mode {self.mode!r}: allowed are peer and client")

    @property
    def session_mode(self) -> str:
        """The resulting Zenoh session mode, "peer" or "client"."""
        return self.mode or ("peer" if self.listen else "client")

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        values: dict[str, Any] = plain(self, finite=False)
        return values

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> WireOptions:
        """Return the options that :meth:`to_json` wrote."""
        return from_values(cls, values)


@dataclass(frozen=True, slots=True, kw_only=True)
class TopicEnd:
    """A writer or reader of a topic in another program, as the network's discovery shows it.

    Attributes:
        who: Its program, for messages.
        writes: Whether it writes the topic; else it reads it.
        type_name: DDS name of the topic's type there; "" if it is not shown.
        type_hash: ROS 2's hash of that type; "" if it is not shown.
        ours: Whether it is a deal-hw that commands robots from this computer.
    """

    who: str
    writes: bool
    type_name: str = ""
    type_hash: str = ""
    ours: bool = False


class TopicTransport(Transport):
    """A transport of messages with topics: publish and subscribe, without a specific peer.

    Topics are named as on the wire of DDS, without a leading slash (``rt/lowstate``); payloads are whole CDR
    messages with their 4-byte header. ``receive`` returns the messages of all subscribed topics in order of
    arrival, never our own; ``send`` accepts declared topics only. A topic without a listener is no error.

    Args:
        port: An end point or a network interface.
        clock: Clock of the stamps.
        options: Options of the connection.
    """

    @abc.abstractmethod
    def declare(self, *, publish: Collection[str] = (), subscribe: Collection[str] = ()) -> None:
        """Declare the used topics; call it before ``open``.

        Raises:
            UnknownNameError: The transport does not know the topic's type.
        """

    @abc.abstractmethod
    def writers(self, topic: str) -> tuple[str, ...]:
        """Return a description of each other participant that is known to write a subscribed topic.

        A transport that cannot know them (Zenoh) returns nothing; for certainty, listen to the topic as well.
        """

    def ends(self, topic: str) -> tuple[TopicEnd, ...] | None:
        """Return the writers and readers of a declared topic in other programs; None: it cannot know them."""
        return None

    def name_types(self, types: Mapping[str, str]) -> None:
        """Name the DDS types of topics that have another type than usual; call it before ``open``.

        Does nothing on a transport that needs no types.

        Args:
            types: Topic -> name of its type.
        """

    @property
    def stream(self) -> int | None:
        """Number of the stream of our messages, by which a bridge identifies us; None if there is none."""
        return None
