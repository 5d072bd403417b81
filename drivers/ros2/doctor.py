"""Looks at who is on the robot's topics; sends nothing."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Final

from deal_hw.clock import Clock
from deal_hw.drivers.ros2.connect import make_link
from deal_hw.drivers.ros2.graph import Graph
from deal_hw.drivers.ros2.topics import ros_topic, topics_of
from deal_hw.drivers.transports.listen_only import listen_only
from deal_hw.errors import TransportTimeoutError
from deal_hw.findings import Finding, Severity
from deal_hw.sim.robots.ros2_section import Ros2Section
from deal_hw.transport import TopicTransport

LISTEN_S: Final = 1.5
"""Time for discovery, and for commands of other programs [s]."""


def examine_topics(section: Ros2Section, wire: str, port: str, clock: Clock) -> Iterator[Finding]:
    """Yield findings on the publishers and subscribers of a robot's topics.

    Args:
        section: Its topics.
        wire: "dds" or "zenoh".
        port: A network interface, or the end point of the router.
        clock: For the waiting.

    Raises:
        TransportError: The transport cannot be opened.
    """
    link = listen_only(make_link(section, wire, port, clock))
    if not isinstance(link, TopicTransport):
        return
    topics = topics_of(section)
    graph = Graph(link, topics, section)
    link.declare(subscribe=[topics.states, topics.commands])
    commands = 0
    with link:
        end_ns = clock.now_ns() + round(LISTEN_S * 1e9)
        while (left_ns := end_ns - clock.now_ns()) > 0:
            with contextlib.suppress(TransportTimeoutError):
                commands += link.receive(left_ns * 1e-9).channel == topics.commands
        for topic in (topics.states, topics.commands):
            for end in link.ends(topic) or ():
                role = "publishes" if end.writes else "subscribes to"
                yield Finding("topics", Severity.OK, f"{end.who} {role} {ros_topic(topic)}")
        mismatch, controlled, foreign = graph.mismatch(), graph.controlled, graph.foreign()
    if mismatch is not None:
        yield Finding("topics", Severity.FAIL, str(mismatch))
    if controlled is False:
        yield Finding("topics", Severity.FAIL, graph.no_controller())
    if foreign or commands:
        text = f"{graph.foreign_complaint(foreign)} ({commands} commands in {LISTEN_S:g} s)"
        yield Finding("topics", Severity.FAIL, text)
    else:
        yield Finding("topics", Severity.OK, f"nobody else publishes on {ros_topic(topics.commands)}")
