"""``trms serve``: a page of all runs, for a browser on this machine."""

from __future__ import annotations

import sys
from pathlib import Path

from trms_cli.commands.plain_options import PlainOptions
from trms_cli.core.errors import EXIT_OK, ConfigurationError, Termination
from trms_cli.core.printable import printable

SUMMARY = "a page of all runs in the browser of this machine: filter, compare, watch live ones"

#: Where it is unless somebody says otherwise.
PORT = 8760

HELP = f"""\
Usage: trms serve [FOLDER]… [--port N] [--all] [--open]

Serves a page of the runs under the working folder, or under others, to a browser on this machine:
a list to filter, sort and choose from, the report of each, runs over one another, whole sweeps. A
run that is going on is drawn as it goes on. Open the address that it prints. Ctrl-C ends it.

Only this machine can reach it (127.0.0.1), and only a browser that was given the address with its
token. Nothing can be written or started by it.

  FOLDER        runs are looked for here, however deep
  --port N      the port ({PORT}); 0 takes one that is free
  --all         every run that this machine knows of, in the place of folders
  --open        open it in the browser at once

Examples:
  trms serve
  trms serve outputs sweep port=8761
  trms serve --all --open

filters of the list are those of trms runs: rmse_yaw < 0.05 and controller == 'pid'
"""

_LARGEST_PORT = 65535


def main(argv: list[str]) -> int:
    """Run the command; return the exit code."""
    options = PlainOptions("trms serve", HELP)
    options.add_argument("folders", type=Path, nargs="*", metavar="FOLDER")
    options.add_argument("--port", type=int, default=PORT)
    options.add_flags("--all", "--open")
    arguments = options.parse_args(argv)
    if not 0 <= arguments.port <= _LARGEST_PORT:
        raise ConfigurationError(
            f"{arguments.port} is no port", where="port", remedy=f"from 0 to {_LARGEST_PORT}"
        )
    if arguments.all and arguments.folders:
        options.error("--all goes without a folder")

    from trms_cli.library.server.application import application_of, listening_socket, serve
    from trms_cli.library.server.catalogue import Catalogue
    from trms_cli.reporting.progress import ReadingProgress, termination
    from trms_cli.runs.query import Query

    catalogue = Catalogue(arguments.folders, everywhere=arguments.all)
    try:
        with termination(), listening_socket(arguments.port) as own:
            with ReadingProgress() as progress:
                count = catalogue.find(Query(columns=("log",), limit=1), progress).of
            port = own.getsockname()[1]
            application = application_of(catalogue, port)
            address = application.address
            _say(catalogue.folders, count, address)
            if arguments.open:
                import webbrowser

                webbrowser.open(address)
            serve(application, own)
    except Termination:
        raise
    except KeyboardInterrupt:
        print("\nended; nothing was written")
    finally:
        catalogue.close()
    return EXIT_OK


def _say(folders: tuple[Path, ...], count: int, address: str) -> None:
    where = ", ".join(str(folder.resolve()) for folder in folders) or "this machine"
    print(f"runs       {count} in {printable(where)}")
    print(f"open       {address}")
    print("           on this machine alone; the address lets in whoever has it. Ctrl-C ends it.")
    sys.stdout.flush()
