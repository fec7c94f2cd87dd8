"""Description of the API for programs: ``GET /openapi.json`` (OpenAPI 3.1)."""

from __future__ import annotations

from typing import Any

from eap.release import RELEASE

_STATION = {"name": "station", "in": "path", "required": True, "schema": {"type": "string"}}
_VARIABLE = {
    "name": "variable",
    "in": "path",
    "required": True,
    "description": "Name of a variable or of a member; * stands for any text.",
    "schema": {"type": "string"},
}
_VALUE = {
    "type": "object",
    "required": ["value", "unit", "quality", "age_us", "time", "stale"],
    "properties": {
        "value": {"description": "As in the control protocol; null if it is no finite number."},
        "unit": {"type": "string"},
        "quality": {
            "type": ["integer", "null"],
            "description": "Age of received data in units of 100 us; null for all other variables.",
        },
        "age_us": {"type": ["integer", "null"], "description": "null before the first data."},
        "time": {
            "type": ["number", "null"],
            "description": "Unix time of the data; null before the first.",
        },
        "stale": {"type": "boolean", "description": "Too old to be relied on."},
    },
}
_ERROR = {
    "type": "object",
    "properties": {
        "error": {"type": "object", "properties": {"message": {"type": "string"}}},
    },
}


def _json(schema: dict[str, Any], description: str) -> dict[str, Any]:
    return {"description": description, "content": {"application/json": {"schema": schema}}}


def _ref(name: str) -> dict[str, Any]:
    return {"$ref": f"#/components/schemas/{name}"}


def _by_name(name: str) -> dict[str, Any]:
    return {"type": "object", "additionalProperties": _ref(name)}


def _get(summary: str, schema: dict[str, Any], *parameters: dict[str, Any]) -> dict[str, Any]:
    return {
        "summary": summary,
        "parameters": list(parameters),
        "responses": {"200": _json(schema, "The answer."), "default": _json(_ref("Error"), "Why.")},
    }


def _post(summary: str, body: dict[str, Any], *parameters: dict[str, Any]) -> dict[str, Any]:
    return {
        **_get(summary, {"type": "object"}, *parameters),
        "requestBody": {"required": True, "content": {"application/json": {"schema": body}}},
    }


_OBJECT: dict[str, Any] = {"type": "object"}
_TEXT = {"type": "string"}

DOCUMENT: dict[str, Any] = {
    "openapi": "3.1.0",
    "info": {
        "title": "EAP appliance",
        "version": RELEASE,
        "summary": "Values, status and trends of a plant.",
    },
    "servers": [{"url": "/"}],
    "security": [{}, {"session": []}, {"password": []}],
    "paths": {
        "/api/v1/{station}/{variable}": {
            "get": _get(
                "Present value; with *, an object of values by STATION/VARIABLE.",
                {"oneOf": [_ref("Value"), _by_name("Value")]},
                _STATION,
                _VARIABLE,
            ),
            "post": _post("Set a variable of the application.", _ref("Write"), _STATION, _VARIABLE),
        },
        "/api/v1/history/{station}/{variable}": {
            "get": _get(
                "Past values of variables that a trend shows.",
                _by_name("History"),
                _STATION,
                _VARIABLE,
                {"name": "window", "in": "query", "schema": _TEXT, "example": "10m"},
            )
        },
        "/api/v1/status": {"get": _get("The document of eapctl status --json.", _OBJECT)},
        "/api/v1/plant": {"get": _get("Overview: stations, PDs, buses, findings.", _OBJECT)},
        "/api/v1/variables": {"get": _get("All variables with type, unit, comment.", _OBJECT)},
        "/api/v1/pages": {"get": _get("The pages and their panels.", _OBJECT)},
        "/api/v1/events": {"get": _get("The latest events.", _OBJECT)},
        "/api/v1/routes/{station}/": {"get": _get("AMS routes of a station.", _OBJECT, _STATION)},
        "/metrics": {
            "get": {
                "summary": "Metrics for Prometheus.",
                "responses": {
                    "200": {
                        "description": "The answer.",
                        "content": {"application/openmetrics-text": {"schema": _TEXT}},
                    },
                    "default": _json(_ref("Error"), "Why."),
                },
            }
        },
        "/api/v1/session": {"get": _get("User, role and token for changes.", _OBJECT)},
        "/api/v1/login": {"post": _post("Begin a session.", _ref("Login"))},
        "/api/v1/logout": {"post": _post("End the session.", _OBJECT)},
    },
    "components": {
        "securitySchemes": {
            "session": {"type": "apiKey", "in": "cookie", "name": "eap-session"},
            "password": {"type": "http", "scheme": "basic"},
        },
        "schemas": {
            "Value": _VALUE,
            "Error": _ERROR,
            "Write": {
                "type": "object",
                "required": ["value"],
                "properties": {"value": {}, "comment": _TEXT},
                "additionalProperties": False,
            },
            "Login": {
                "type": "object",
                "required": ["user", "password"],
                "properties": {"user": _TEXT, "password": _TEXT},
            },
            "History": {
                "type": "object",
                "properties": {
                    "unit": _TEXT,
                    "times": {"type": "array", "items": {"type": "number"}},
                    "values": {"type": "array", "items": {"type": ["number", "null"]}},
                },
            },
        },
    },
}
