"""Documents that a command goes on from: keys of blind sets, requests of fits, allowed packages."""

import json
import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from unittest.mock import patch


def seeds(folder: Path) -> Iterator[bytes]:
    """One of each."""
    from experiments.gap.blind.sealing import KEY_SCHEMA

    case = {"kind": "effect", "effects": {"yaw_dead_zone": {"width": 0.1}}, "parameters": {}}
    content = {"set": "small", "seed": 1, "cases": {"rig_01": case}, "files": {}}
    yield json.dumps({"schema": KEY_SCHEMA, "salt": "00", "key": content}).encode()
    request = {"overrides": ["seed=1"], "config_dirs": ["/lab"], "working_folder": "/"}
    yield json.dumps(request).encode()
    yield b'{"schema": "trms.allowed/1", "packages": {"my_lab": "/lab", "other": null}}'


def read(data: bytes, folder: Path) -> None:
    """Each of the readers, whatever the document is."""
    from experiments.gap.blind.sealing import open_key
    from trms_cli.commands.resume import Resumption
    from trms_cli.core.errors import TrmsError
    from trms_cli.core.trust import allowed_file, allowed_for_good
    from trms_cli.library.tasks.files import REQUEST_NAME

    with patch.dict(os.environ, {"XDG_CONFIG_HOME": str(folder)}):
        allowed_file().parent.mkdir(exist_ok=True)
        for path in (folder / "key.json", folder / REQUEST_NAME, allowed_file()):
            path.write_bytes(data)
        _commit(data, folder)
        resumption = Resumption("fit", "fit", "identify", (), "", lambda folder, text: None)
        with suppress(TrmsError):
            resumption._request(folder / REQUEST_NAME)
        with suppress(TrmsError):
            open_key(folder / "key.json", folder)
        allowed_for_good()


def _commit(data: bytes, folder: Path) -> None:
    """The commitment to whatever the key is: without it nothing of a key is looked at."""
    from experiments.gap.blind.sealing import COMMITMENT, COMMITMENT_SCHEMA, _commitment

    with suppress(ValueError, TypeError, KeyError, AttributeError, RecursionError):
        key = json.loads(data)
        told = {"schema": COMMITMENT_SCHEMA, "sha256": _commitment(key["salt"], key["key"])}
        (folder / COMMITMENT).write_text(json.dumps(told))
