"""The command that shows a policy live."""

import contextlib
import json
import webbrowser
from collections.abc import Generator
from typing import TYPE_CHECKING, Any

from gacrl import tasks
from gacrl.cli.output import warn
from gacrl.cli.words import Words
from gacrl.extras import require_extra

if TYPE_CHECKING:
    from gacrl.cli.arguments import Page
    from gacrl.cli.terminal import TerminalWatcher
    from gacrl.training.watching import Watcher

PACKAGES = ("starlette", "uvicorn", "websockets")


def view(words: Words) -> int:
    """Serve a page on which one policy or two play, until Ctrl-C."""
    from gacrl.cli import arguments, parsing

    asked, rest = parsing.parse_known(arguments.View, words, "view")
    require_extra("view", *PACKAGES)
    from gacrl.training.devices import prepare_jax

    prepare_jax()
    from gacrl.viewer import following, lore, running
    from gacrl.viewer.cast import open_cast
    from gacrl.viewer.server import Board

    def change(settings: Any) -> Any:
        short = [] if asked.num_agents is None else ["--num-agents", str(asked.num_agents)]
        return parsing.changed(settings, [*rest, *short], "view", arguments.View)

    with running.listening(asked.host, asked.port) as listener:
        cast = open_cast(asked.run, words.task or tasks.DEFAULT, change, asked.sampled, warn)
        print(f"compiling the policy of {' and '.join(asked.run)}", flush=True)
        running.warm_up(cast)
        board = Board()
        server = running.Running(cast, listener, asked.host, running.new_token(), board)
        busy = server.server.busy
        running.beside(lambda: running.warm_up_the_rest(cast, busy), lambda: lore.keep_telling(cast, board))
        running.beside(lambda: following.follow(cast, board))
        print(f"page       {server.address}", flush=True)
        print("           Ctrl-C ends it; the address is a key: give it to nobody else", flush=True)
        if asked.json:
            print(json.dumps({"url": server.address}), flush=True)
        if asked.open:
            webbrowser.open(server.address)
        server.run()
    return 0


@contextlib.contextmanager
def shown(page: "Page", words: Words, terminal: "TerminalWatcher") -> "Generator[Watcher]":
    """Serve a page beside a training, where one is asked for; one process of several does."""
    from gacrl.training.watching import Watcher

    if not page.view or terminal.quiet:
        yield Watcher()
        return
    require_extra("view", *PACKAGES)
    from gacrl.viewer.beside import page_beside

    with page_beside(page.view_host, page.view_port, words.named, terminal.note) as watcher:
        yield watcher
