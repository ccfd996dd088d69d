"""Commands view and convert: a result for a browser, and for other programs."""

from __future__ import annotations

import webbrowser
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Annotated

import typer

from soup_nlp.cli.options import Overwrite, listed
from soup_nlp.errors import DataError
from soup_nlp.report.folder import convert as convert_folder
from soup_nlp.report.folder import renew_page
from soup_nlp.report.formats import FORMATS
from soup_nlp.report.result import PAGE
from soup_nlp.sequence.stored import convert_chain, is_chain
from soup_nlp.sequence.write import CHAIN_PAGE, renew_chain_page


def view(
    folder: Annotated[Path, typer.Argument(help="Folder of a result or a chain.")],
    serve: Annotated[
        int | None,
        typer.Option(help="Serve the folder to this machine at a port instead; 0 chooses one."),
    ] = None,
    renew: Annotated[bool, typer.Option("--renew", help="Generate the page again.")] = False,
    no_open: Annotated[
        bool, typer.Option("--no-open", help="Do not open a browser, print the address.")
    ] = False,
) -> None:
    """Open the page of a result in a browser, or serve it."""
    page, renewed = (CHAIN_PAGE, renew_chain_page) if is_chain(folder) else (PAGE, renew_page)
    place = folder / page
    if renew or not place.is_file():
        place = renewed(folder)
    if serve is None:
        address = place.resolve().as_uri()
        opened = not no_open and webbrowser.open(address)
        print(f"opened      {place}" if opened else f"open        {address}")
        return
    handler = partial(SimpleHTTPRequestHandler, directory=str(folder))
    try:
        server = ThreadingHTTPServer(("127.0.0.1", serve), handler)
    except (OSError, OverflowError) as error:
        raise DataError(
            "port cannot be used",
            where="--serve",
            found=f"{serve}: {error}",
            expected="a free port",
            hint="--serve 0 chooses one",
        ) from error
    with server:
        address = f"http://127.0.0.1:{server.server_address[1]}/{page}"
        print(f"serving     {address} until Ctrl-C", flush=True)
        if not no_open:
            webbrowser.open(address)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            print("stopped")


_NAMES = "; ".join(f"{name}: {text}" for name, (_, text) in FORMATS.items())


def convert(
    folder: Annotated[Path, typer.Argument(help="Folder of a result or a chain.")],
    to: Annotated[str, typer.Option("--to", help=f"Comma separated. {_NAMES}.")],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Output folder; default the result's own.")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Write a result for other programs: ply, glb, colmap, npy, pfm, png, rrd, motions."""
    target = folder if out is None else out
    write = convert_chain if is_chain(folder) else convert_folder
    for name in write(folder, listed(to), out, overwrite):
        print(target / name)
