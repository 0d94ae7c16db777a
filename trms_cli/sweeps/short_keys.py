"""Names of varied keys that are short and still told apart, for tables and pictures."""

from __future__ import annotations

from collections.abc import Sequence

_TABLE = "parameters"


def short_keys(keys: Sequence[str]) -> dict[str, str]:
    """The last two parts of each key, with as much before them as tells it from the others.

    ``controller.state_weights.alpha_v`` becomes ``state_weights.alpha_v``; of a parameter, as
    ``plant.parameters.k_g``, the name is enough.
    """
    split = {key: key.split(".") for key in keys}
    short = {}
    for key, parts in split.items():
        size = 1 if parts[-2:-1] == [_TABLE] else 2
        while size < len(parts) and any(
            other != key and others[-size:] == parts[-size:] for other, others in split.items()
        ):
            size += 1
        short[key] = ".".join(parts[-size:])
    return short
