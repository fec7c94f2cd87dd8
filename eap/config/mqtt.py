"""The key ``mqtt`` of a plant file: checks, and the record that the bridge gets."""

from __future__ import annotations

import re
from pathlib import Path

from msgspec.structs import replace

from eap.ams.spec import MqttSpec, TransportKind
from eap.config.bridge_sections import MqttBridgeSpec, MqttSection
from eap.config.brokers import URL, broker_spec, brokers_of, check_credentials, parse_url
from eap.config.finding import FindingReport, PlantFinding, one_of
from eap.config.index import Index
from eap.config.selection import VariableNames, paths_of, reason_not_settable
from eap.config.structs import RouteSection, StationSection
from eap.patterns import match_names
from eap.suggest import suggest

_PLACEHOLDER = re.compile(r"\{[^{}]*\}")
_PLACEHOLDERS = ("{plant}", "{station}", "{variable}")
_FORBIDDEN = set("+#\0")
_TOPIC = "levels with {station} and {variable} in them, such as {plant}/{station}/{variable}"
_LEVEL = "one level of a topic: no spaces, no / + #"


def mqtt_spec(index: Index, section: MqttSection, folder: Path) -> MqttBridgeSpec:
    """Return *section*, which has no findings, with its broker and the paths of its files."""
    return MqttBridgeSpec(section, _broker(index, section, folder))


def _broker(index: Index, section: MqttSection, folder: Path) -> MqttSpec:
    route = _route(index, section)
    own = RouteSection(
        mqtt=section.broker if route is None else route.mqtt,
        user=section.user,
        password_file=section.password_file,
        tls=section.tls,
    )
    if route is not None:
        # The login of the station, unless the bridge has one of its own.
        if not section.user:
            own = replace(own, user=route.user, password_file=route.password_file)
        own = replace(own, tls=section.tls or route.tls)
    return broker_spec(own, folder)


def _route(index: Index, section: MqttSection) -> RouteSection | None:
    """Return the broker of the first station that is in the network *broker*, if it names one."""
    for station in index.plant.stations:
        for route in brokers_of(station):
            if route.network == section.broker:
                return route
    return None


def check_mqtt(index: Index, report: FindingReport, folder: Path) -> None:
    """Report every invalid key of ``mqtt``; files are in *folder*."""
    section = index.plant.mqtt
    if section is None:
        return
    _check_broker(index, section, report)
    check_credentials(section, report, folder)
    _check_topic(section, report)
    names = VariableNames(index, report)
    for each in section.publish:
        for path, pattern in paths_of(each.of, f"{each.at}.of" if each.at else section.at):
            names.check_pattern(path, pattern)
        if 0 < each.every_ms < section.period_ms:
            message = f"every_ms is {each.every_ms}, and values are read every {section.period_ms}"
            report.add(f"{each.at}.every_ms", message, f"at least period_ms ({section.period_ms})")
    for position, pattern in enumerate(section.commands):
        path = f"{section.at}.commands[{position}]"
        names.check_pattern(path, pattern)
        _check_settable(index, names, path, pattern, report)
    _check_names(section, report)


def _check_names(section: MqttSection, report: FindingReport) -> None:
    """Report invalid names of Sparkplug and Home Assistant, and a bridge that publishes nothing."""
    if (sparkplug := section.sparkplug) is not None:
        for key, text in (("group", sparkplug.group), ("node", sparkplug.node)):
            if (text or key == "group") and not _is_level(text):
                report.add(f"{sparkplug.at}.{key}", f"{key} {text!r}", _LEVEL)
    if section.discovery and not all(map(_is_level, section.discovery.split("/"))):
        path = f"{section.at}.home_assistant"
        report.add(path, f"home_assistant: {section.discovery!r}", "true, or levels of topics")
    if not section.has_json and section.sparkplug is None:
        report.add(f"{section.at}.json", "nothing is published", "json: true, or sparkplug")


def warn_of_commands(index: Index, report: FindingReport) -> list[PlantFinding]:
    """Return a warning for each station that no access rule opens for its commands."""
    section = index.plant.mqtt
    if section is None or not section.commands:
        return []
    names = VariableNames(index, report)
    found = []
    for position, pattern in enumerate(section.commands):
        for station in sorted({n.partition("/")[0] for n in _fitting(names, pattern)}):
            if not _has_rule(index.stations[station]):
                path = f"{section.at}.commands[{position}]"
                message = f"commands for {station} are refused: no access rule allows them"
                expected = "access: [{allow: [write], transports: [mqtt]}]"
                line = report.line_of(path)
                found.append(PlantFinding(report.file, line, path, message, expected))
    return found


def _fitting(names: VariableNames, pattern: str) -> list[str]:
    return match_names(pattern, names.names) if "*" in pattern else [pattern]


def _has_rule(station: StationSection) -> bool:
    """Return whether a rule may allow writes by MQTT; its other conditions are its own affair."""
    return any(
        rule.allow and (not (kinds := rule.transports or rule.doors) or TransportKind.MQTT in kinds)
        for rule in station.access
    )


def _check_broker(index: Index, section: MqttSection, report: FindingReport) -> None:
    path = f"{section.at}.broker"
    if "://" in section.broker:
        try:
            parse_url(section.broker)
        except ValueError as exc:
            report.add(path, f"broker: {exc}", URL)
    elif _route(index, section) is None:
        networks = {
            route.network for station in index.plant.stations for route in brokers_of(station)
        }
        message = f"broker {section.broker!r} is no network of a broker of this plant"
        message += suggest(section.broker, networks)
        report.add(path, message, one_of(sorted(networks)) if networks else URL)


def _check_topic(section: MqttSection, report: FindingReport) -> None:
    path, topic = f"{section.at}.topic", section.topic
    unknown = [each for each in _PLACEHOLDER.findall(topic) if each not in _PLACEHOLDERS]
    rest = _PLACEHOLDER.sub("x", topic)
    if unknown:
        message = f"topic: unknown {unknown[0]}{suggest(unknown[0], _PLACEHOLDERS)}"
        report.add(path, message, one_of(_PLACEHOLDERS))
    elif not {"{station}", "{variable}"} <= set(_PLACEHOLDER.findall(topic)):
        report.add(path, f"topic {topic!r} is the same for several variables", _TOPIC)
    elif set(rest) & _FORBIDDEN or not all(rest.split("/")) or rest.startswith("$"):
        report.add(path, f"topic {topic!r} is no topic", _TOPIC)


def _check_settable(
    index: Index, names: VariableNames, path: str, pattern: str, report: FindingReport
) -> None:
    """Report a variable that nobody can set, and a pattern that only such fit."""
    found = [name.partition("/") for name in _fitting(names, pattern)]
    reasons = [
        reason_not_settable(index, index.stations[station], variable)
        for station, _, variable in found
        if station in index.stations
    ]
    if reasons and all(reasons):
        message = f"variable {pattern} cannot be set: {reasons[0]}"
        report.add(path, message, "a variable without source and link")


def _is_level(text: str) -> bool:
    return bool(text) and text.isprintable() and not set(text) & set("+#/ ")
