"""Zenoh's settings for TLS with certificates on both sides, rights by role, and size limits."""

from __future__ import annotations

from typing import Any, Literal

from node_runtime.tls.credentials import Credentials
from protocol import topics
from protocol.rights import ROLES, common_name, rights_of

SECURE = ["tls", "quic"]
PLAIN = ["tcp"]
MESSAGES = [
    "put",
    "delete",
    "declare_subscriber",
    "query",
    "reply",
    "declare_queryable",
    "liveliness_token",
    "liveliness_query",
    "declare_liveliness_subscriber",
]


def client_settings(own: Credentials) -> dict[str, Any]:
    """Return the settings of a session that connects by `tls/` or `quic/`."""
    return {"transport/link/tls": _link("connect", own) | {"verify_name_on_connect": True}}


def router_settings(own: Credentials, plant: str) -> dict[str, Any]:
    """Return the settings of a router at `tls/` or `quic/`: clients need certificates and have limited rights."""
    return {
        "transport/link/tls": _link("listen", own),
        "access_control": access_control(plant),
        "low_pass_filter": size_limits(plant),
    }


def _link(way: Literal["connect", "listen"], own: Credentials) -> dict[str, Any]:
    return {
        "root_ca_certificate": str(own.authority),
        "enable_mtls": True,
        f"{way}_private_key": str(own.key),
        f"{way}_certificate": str(own.certificate),
        "close_link_on_expiration": True,
    }


def access_control(plant: str) -> dict[str, Any]:
    """Return Zenoh's rules: all rights on plain links, which stay on the machine, and rights by certificate on others.

    The default is to deny. "ingress" is from the holder of a certificate to the router, "egress" the opposite
    direction.
    """
    rules = [
        _rule("plain", MESSAGES, ["ingress", "egress"], ["**", topics.below("*", f"{topics.DIRECT}/**")])
    ]
    subjects: list[dict[str, Any]] = [{"id": "plain", "link_protocols": PLAIN}]
    policies = [{"rules": ["plain"], "subjects": ["plain"]}]
    # Clients need the subscriptions of others: a publisher that sees no subscriber sends nothing.
    all_keys = [topics.everything(plant), topics.below(plant, f"{topics.DIRECT}/**")]
    rules.append(_rule("matching", ["declare_subscriber", "declare_queryable"], ["egress"], all_keys))
    for role in ROLES:
        rights = rights_of(role)
        own = [
            _rule(f"{role} publishes", ["put"], ["ingress"], rights.publish_keys(plant)),
            _rule(f"{role} subscribes", ["declare_subscriber"], ["ingress"], rights.read_keys(plant)),
            _rule(f"{role} hears", ["put"], ["egress"], rights.read_keys(plant)),
            _rule(f"{role} asks", ["query"], ["ingress"], rights.ask_keys(plant)),
            _rule(f"{role} is answered", ["reply"], ["egress"], rights.ask_keys(plant)),
            _rule(f"{role} offers", ["declare_queryable"], ["ingress"], rights.answer_keys(plant)),
            _rule(f"{role} is asked", ["query"], ["egress"], rights.answer_keys(plant)),
            _rule(f"{role} answers", ["reply"], ["ingress"], rights.answer_keys(plant)),
        ]
        own = [rule for rule in own if rule["key_exprs"]]
        rules.extend(own)
        subjects.append(
            {"id": role, "link_protocols": SECURE, "cert_common_names": [common_name(role, plant)]}
        )
        policies.append({"rules": ["matching", *(rule["id"] for rule in own)], "subjects": [role]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def size_limits(plant: str) -> list[dict[str, Any]]:
    """Return the router's size limits by topic for messages that arrive on links with certificates."""
    limits: dict[int, list[str]] = {}
    for topic in topics.ALL:
        limits.setdefault(topic.max_bytes, []).extend(topic.keys(plant))
    limits.setdefault(topics.USER_MAX_BYTES, []).append(topics.user_keys(plant))
    filters = [_limit(f"up to {size}", ["put"], keys, size) for size, keys in limits.items()]
    all_keys = [topics.everything(plant)]
    filters.append(_limit("questions", ["query"], all_keys, topics.LARGEST_QUESTION))
    filters.append(_limit("answers", ["reply"], all_keys, topics.LARGEST_MESSAGE))
    return filters


def _rule(name: str, messages: list[str], flows: list[str], keys: list[str]) -> dict[str, Any]:
    return {"id": name, "permission": "allow", "messages": messages, "flows": flows, "key_exprs": keys}


def _limit(name: str, messages: list[str], keys: list[str], size: int) -> dict[str, Any]:
    return {
        "id": name,
        "link_protocols": SECURE,
        "flows": ["ingress"],
        "messages": messages,
        "key_exprs": keys,
        "size_limit": size,
    }
