"""Command view: the page of a result in a browser."""

from __future__ import annotations

import webbrowser
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Annotated

import typer

from soup_nlp.errors import DataError
from soup_nlp.report.folder import renew_page
from soup_nlp.report.result import PAGE
from soup_nlp.sequence.stored import is_chain
from soup_nlp.sequence.write import CHAIN_PAGE, renew_chain_page


def view(
    folder: Annotated[Path, typer.Argument(help="Folder of a result or a chain.")],
    serve: Annotated[
        int | None,
        typer.Option(help="Serve the folder at this port of this machine instead; 0 chooses one."),
    ] = None,
    renew: Annotated[bool, typer.Option("--renew", help="Make the page anew.")] = False,
    no_open: Annotated[
        bool, typer.Option("--no-open", help="Do not open a browser, print the address.")
    ] = False,
) -> None:
    """Open the page of a result in a browser, or serve it."""
    page = CHAIN_PAGE if is_chain(folder) else PAGE
    place = folder / page
    if page != PAGE:
        if renew or not place.is_file():
            place = renew_chain_page(folder)
    elif renew or not place.is_file():
        place = renew_page(folder)
    if serve is None:
        address = place.resolve().as_uri()
        opened = not no_open and webbrowser.open(address)
        print(f"opened      {place}" if opened else f"open        {address}")
        return
    with _server(folder, serve) as server:
        address = f"http://127.0.0.1:{server.server_address[1]}/{page}"
        print(f"serving     {address} until Ctrl-C", flush=True)
        if not no_open:
            webbrowser.open(address)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            print("stopped")


def _server(folder: Path, port: int) -> ThreadingHTTPServer:
    """A server of a folder that only this machine can reach.

    Raises:
        DataError: the port cannot be used.
    """
    try:
        return ThreadingHTTPServer(
            ("127.0.0.1", port), partial(SimpleHTTPRequestHandler, directory=str(folder))
        )
    except (OSError, OverflowError) as error:
        raise DataError(
            "port cannot be used",
            where="--serve",
            found=f"{port}: {error}",
            expected="a free port",
            hint="--serve 0 chooses one",
        ) from error
