"""``python -m tests.fuzz TARGET [--minutes M]``: attack a reader, and tell what came of it."""

import argparse
import json
import re
import subprocess
import sys
import time
from pathlib import Path

from tests.fuzz.target import Target, all_targets

_MEMORY = 1024  # MiB; libFuzzer ends the hunt above
_ENDLESS = 60  # s of wall time for one input; processor time is watched more closely


def main() -> int:
    """Run the targets that were named, one after another."""
    targets = {target.name: target for target in all_targets()}
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("target", nargs="*", help="what to attack; `all` for everything")
    parser.add_argument("--minutes", type=float, default=10.0, help="for each target")
    parser.add_argument("--folder", type=Path, default=Path("outputs/fuzz"))
    parser.add_argument("--list", action="store_true", help="tell which targets there are")
    asked = parser.parse_args()
    unknown = set(asked.target) - {*targets, "all"}
    if asked.list or not asked.target or unknown:
        for target in targets.values():
            print(f"{target.name:10} {target.about}")
        return 2 if unknown else 0
    chosen = targets if "all" in asked.target else asked.target
    found = [_attacked(targets[name], asked.folder / name, asked.minutes) for name in chosen]
    return 1 if any(found) else 0


def _attacked(target: Target, folder: Path, minutes: float) -> bool:
    """Whether anything was found."""
    folder.mkdir(parents=True, exist_ok=True)
    options = [
        f"-max_total_time={round(minutes * 60)}",
        f"-timeout={_ENDLESS}",
        f"-rss_limit_mb={_MEMORY}",
        f"-artifact_prefix={folder}/",
        f"-max_len={getattr(target.module, 'LONGEST', 8192)}",
        "-print_final_stats=1",
    ]
    begin = time.monotonic()
    with (folder / "log").open("w", encoding="utf-8") as log:
        command = [sys.executable, "-m", "tests.fuzz.hunt", target.name, str(folder), *options]
        code = subprocess.run(command, stdout=log, stderr=log, check=False).returncode
    text = (folder / "log").read_text(encoding="utf-8", errors="replace")
    coverage = [int(number) for number in re.findall(r"cov: (\d+)", text)] or [0]
    runs = [int(number) for number in re.findall(r"#(\d+)", text)] or [0]
    memory = re.findall(r"peak_rss_mb:\s*(\d+)", text) or re.findall(r"rss: (\d+)Mb", text)
    places = sorted(path.name[:-4] for path in (folder / "found").glob("*.txt"))
    ended = sorted(
        p.name for p in folder.iterdir() if p.name.startswith(("timeout", "oom", "crash"))
    )
    told = {
        "target": target.name,
        "minutes": round((time.monotonic() - begin) / 60, 1),
        "executions": max(runs),
        "coverage": [coverage[0], coverage[-1]],
        "peak_rss_mb": int(memory[-1]) if memory else None,
        "failures": places,
        "ended_by": ended,
        "exit_code": code,
    }
    (folder / "told.json").write_text(json.dumps(told, indent=2) + "\n", encoding="utf-8")
    print(json.dumps(told), flush=True)
    return bool(places or ended)


if __name__ == "__main__":
    sys.exit(main())
