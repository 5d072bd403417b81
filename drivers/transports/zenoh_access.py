"""Access rules of a Zenoh end point, by the name in the certificate that TLS has verified."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from deal_hw.errors import ConfigurationError


def access_settings(
    controllers: Sequence[str], observers: Sequence[str], *, write: Sequence[str], read: Sequence[str]
) -> dict[str, Any]:
    """Return settings of a session that listens; a certificate whose name is not listed has no access.

    Args:
        controllers: Common names of certificates that may write and read.
        observers: Common names of those that may read.
        write: Keys that controllers may write.
        read: Keys that both may read.

    Raises:
        ConfigurationError: A name is in both lists or empty, or there is no controller.
    """
    if twice := set(controllers) & set(observers):
        raise ConfigurationError(
            f"certificate name {sorted(twice)[0]!r} is a controller and an observer; name it once"
        )
    if not controllers or not all((*controllers, *observers)):
        raise ConfigurationError(
            f"controllers {tuple(controllers)}, observers {tuple(observers)}: name at least one controller, "
            "by the common name in its certificate (`deal-hw keys show DIR` lists them)"
        )
    rules = [
        # Declarations in both directions, because each side must receive the other's subscriptions.
        _rule("read", ["put", "delete"], ["egress"], read),
        _rule("hear", ["declare_subscriber"], ["ingress", "egress"], [*read, *write]),
        _rule("write", ["put"], ["ingress"], write),
    ]
    subjects = [
        {"id": name, "cert_common_names": list(names)}
        for name, names in (("controllers", controllers), ("observers", observers))
        if names
    ]
    policies = [{"rules": ["read", "hear", "write"], "subjects": ["controllers"]}]
    if observers:
        policies.append({"rules": ["read", "hear"], "subjects": ["observers"]})
    return {
        "access_control": {
            "enabled": True,
            "default_permission": "deny",
            "rules": rules,
            "subjects": subjects,
            "policies": policies,
        }
    }


def _rule(name: str, messages: list[str], flows: list[str], keys: Sequence[str]) -> dict[str, Any]:
    return {
        "id": name,
        "permission": "allow",
        "messages": messages,
        "flows": flows,
        "key_exprs": list(dict.fromkeys(keys)),
    }
