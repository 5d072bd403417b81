"""What two machines must have in common so that their numbers are the same.

A node without deal-hw runs :func:`facts`, too: it is sent as code, so this module imports nothing of deal-hw,
and all names that it needs are inside functions.
"""

from __future__ import annotations


def facts() -> dict[str, str]:
    """Return the versions of Python and of the packages that compute, and a digest of deal-hw's sources.

    "deal-hw" is missing where deal-hw is not installed.
    """
    import hashlib
    import importlib
    import importlib.metadata
    import pathlib
    import platform

    found = {"python": ".".join(platform.python_version_tuple()[:2])}
    for name in ("numpy", "scipy", "mujoco", "torch"):
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "none"
    try:
        version = importlib.import_module("deal_hw.version").__version__
        folders = [
            (part, path)
            for part in ("", ".calib", ".drivers", ".policies")
            for path in importlib.import_module(f"deal_hw{part}").__path__
        ]
    except (ImportError, AttributeError):
        return found
    digest = hashlib.sha256()
    for part, path in folders:
        for file in sorted(pathlib.Path(path).rglob("*.py")):
            place = file.relative_to(path).as_posix()
            # Installed, these three lie inside the first.
            if not part and place.partition("/")[0] in ("calib", "drivers", "policies", "docs"):
                continue
            digest.update(f"{part}/{place}\n".encode() + file.read_bytes())
    found["deal-hw"], found["sources"] = version, digest.hexdigest()[:12]
    return found


def stamped_facts() -> tuple[dict[str, str], float]:
    """Return the facts, and this machine's clock [s since 1970]."""
    import datetime

    return facts(), datetime.datetime.now(datetime.timezone.utc).timestamp()
