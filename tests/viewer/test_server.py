"""The server of the live page: who is let in, what it answers, and that nothing brings it down."""

import contextlib
import json
import random
import re
import socket
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from serving import TOKEN, Site, Visitor, cast_of, memory, serving
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from gacrl import play
from gacrl.export import html
from gacrl.export.source import Source
from gacrl.training.build import Plan
from gacrl.viewer import lore
from gacrl.viewer.beside import page_beside
from gacrl.viewer.following import learning
from gacrl.viewer.guard import Guard
from gacrl.viewer.server import MOST_VISITORS, Board

SILENCE = {"at": 0, "kind": "fate", "agent": 0, "fate": {"kind": "silence"}}


@pytest.fixture(scope="module")
def reference() -> Iterator[Site]:
    with serving(cast_of("pretrained:gacrl-reference")) as site:
        yield site


def test_the_page_may_run_its_own_script_and_call_its_own_server(reference: Site):
    status, headers, text = reference.get()
    assert status == 200 and headers["referrer-policy"] == "no-referrer" and headers["cache-control"] == "no-store"
    policy = re.search(r'Security-Policy" content="([^"]*)"', text)
    assert policy is not None and "unsafe" not in policy[1]
    assert f"connect-src ws://{reference.host} wss://{reference.host};" in policy[1]
    assert TOKEN not in text, "whoever reads the page without its address has not the key"
    assert "opening.js" in text and "class Session" not in text, "physics and policy stay here"


@pytest.mark.parametrize(
    ("path", "headers", "status"),
    [
        ("/", {}, 403),
        ("/?token=wrong", {}, 403),
        ("/?token=%F0%9F%92%A9", {}, 403),
        (f"/?token={TOKEN}", {"Origin": "http://evil.example"}, 403),
        (f"/?token={TOKEN}", {"Origin": "null"}, 403),
        (f"/?token={TOKEN}", {"Host": "evil.example"}, 400),
        (f"/?token={TOKEN}", {"Host": "127.0.0.1.evil.example:80"}, 400),
        (f"/?token={TOKEN}", {"Host": "127.0.0.1'; script-src *"}, 400),
        (f"/../../etc/passwd?token={TOKEN}", {}, 404),
        (f"/page/main.js?token={TOKEN}", {}, 404),
        (f"/live?token={TOKEN}", {}, 404),
        ("/favicon.ico", {}, 204),
    ],
)
def test_who_is_let_in(reference: Site, path: str, headers: dict[str, str], status: int):
    found, _, text = reference.get(path, **headers)
    assert found == status and "root:" not in text


@pytest.mark.parametrize(
    ("path", "headers", "status"),
    [
        ("/live", {}, 403),
        (f"/live?token={TOKEN}", {"Origin": "http://evil.example"}, 403),
        (f"/live?token={TOKEN}", {"Origin": "http://localhost:1"}, 403),
    ],
)
def test_sockets_are_guarded_alike(reference: Site, path: str, headers: dict[str, str], status: int):
    with pytest.raises(InvalidStatus) as refused, reference.visit(path, **headers):
        pass
    assert refused.value.response.status_code == status


def test_names_of_this_machine():
    here, everywhere = Guard("t", "127.0.0.1"), Guard("t", "0.0.0.0")
    for host, guard, good in (
        ("localhost:99", here, True),
        ("[::1]:99", here, True),
        ("192.168.0.7", here, False),
        ("192.168.0.7:80", everywhere, True),
        ("evil.example", everywhere, False),
        ("", everywhere, False),
    ):
        assert (guard.verdict({"host": host}, "t") is None) == good, host


def test_a_silenced_agent_costs_and_errors_change_nothing(reference: Site):
    lost = 0.0
    with reference.visit() as visitor:
        for seed in range(3):
            visitor.scene(seed, 2, SILENCE)
            last = visitor.frames(0, 25)[-1]
            lost += last["twin"]["earned"] - last["main"]["earned"]
            visitor.send({"kind": "scene", "version": 9, "seed": seed, "count": 7, "events": []})
            assert visitor.hear() == {"kind": "error", "says": "count is a whole number between 2 and 2"}
            time.sleep(0.1)
        assert lost > 3
        assert len(visitor.frames(20, 25)) == 6, "the scene before the error goes on"


def test_eight_pages_at_once_and_no_more(reference: Site):
    def watch(seed: int) -> float:
        with reference.visit() as visitor:
            visitor.scene(seed, 2)
            earned = visitor.frames(0, 25)[-1]["main"]["earned"]
            together.wait(60)
        return earned

    together = threading.Barrier(MOST_VISITORS + 1)
    with ThreadPoolExecutor(MOST_VISITORS) as pool:
        found = [pool.submit(watch, seed) for seed in range(MOST_VISITORS)]
        deadline = time.monotonic() + 60
        while reference.running.server.visitors < MOST_VISITORS and time.monotonic() < deadline:
            time.sleep(0.02)
        with reference.visit() as ninth:
            assert "8 pages are open" in ninth.hear()["says"]
            with pytest.raises(ConnectionClosed):
                ninth.hear()
        together.wait(60)
        assert len({one.result() for one in found}) == MOST_VISITORS
    until(lambda: reference.running.server.visitors == 0)


def until(done: Callable[[], bool], seconds: float = 60) -> None:
    deadline = time.monotonic() + seconds
    while not done():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def nonsense(dice: random.Random) -> str | bytes:
    """A message that is nearly one, or none at all."""
    numbers = [0, 1, 2, 25, -1, 10**9, 1.5, True, None, "x", [], {}, 1e308, "nan"]

    def some() -> object:
        return dice.choice(numbers)

    event = {
        "at": some(),
        "kind": dice.choice(["fate", "move", "cut", "radius", "add", 7]),
        "agent": some(),
        "x": some(),
    }
    scene = {
        "kind": dice.choice(["scene", "frames", "load", ""]),
        "version": some(),
        "seed": some(),
        "count": some(),
    }
    scene |= {"events": [event] * dice.randrange(3), "first": some(), "last": some()}
    text = json.dumps({name: value for name, value in scene.items() if dice.random() < 0.8})
    kind = dice.randrange(10)
    if kind == 0:
        return text.encode()
    if kind == 1:
        return text[: dice.randrange(len(text))]
    return "[" * 60_000 if kind == 2 and dice.random() < 0.02 else text.replace('"nan"', "NaN")


def flood(site: Site, count: int, seed: int) -> None:
    """Send nonsense, take what comes in answer now and then, and vanish in one of several ways."""
    dice = random.Random(seed)
    with contextlib.suppress(ConnectionClosed), site.visit() as visitor:  # also a way to be refused
        for number in range(count):
            visitor.send(nonsense(dice))
            if number % 50 == 0:
                drained(visitor)
        if seed % 2:
            visitor.line.socket.shutdown(socket.SHUT_RDWR)  # without a word


def drained(visitor: Visitor) -> None:
    while True:
        try:
            assert json.loads(visitor.line.recv(timeout=0.001))["kind"] in ("error", "frame")
        except TimeoutError:
            return


@pytest.mark.parametrize("count", [600, pytest.param(10_000, marks=pytest.mark.soak)])
def test_nonsense_and_vanishing_pages_leave_it_up(reference: Site, count: int):
    flood(reference, 100, 0)
    before = memory()
    with ThreadPoolExecutor(MOST_VISITORS) as pool:
        list(pool.map(lambda seed: flood(reference, count // MOST_VISITORS, seed), range(MOST_VISITORS)))
    until(lambda: reference.running.server.visitors == 0)
    assert memory() - before < 48 * 2**20
    with reference.visit() as visitor:
        visitor.scene(1, 2)
        assert visitor.frames(0, 5)[5]["main"]["count"] == 2


def test_what_is_put_up_reaches_who_comes_later(reference: Site):
    rows = [
        {"seed": seed, "env_steps": steps, "greedy": {"return_agent_mean": float(steps + seed)}}
        for steps in (10, 20, 30)
        for seed in (0, 1)
    ]
    curves = learning(rows[:-1], cast_of("pretrained:gacrl-reference").task)
    assert curves == {"label": "return", "steps": [10, 20], "seeds": [[10.0, 20.0], [11.0, 21.0]]}
    reference.board.put("learning", **curves, playing=20)
    with reference.visit() as visitor:
        assert visitor.hear() == {"kind": "learning", **curves, "playing": 20}
    reference.board.notes.clear()


@pytest.mark.soak
def test_what_is_counted_later_is_what_the_exported_page_has(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    board, out = Board(), tmp_path / "page.html"

    def ends(seconds: float) -> None:
        raise StopIteration

    monkeypatch.setattr("gacrl.viewer.lore.time.sleep", ends)
    with pytest.raises(StopIteration):
        lore.keep_telling(cast_of("pretrained:gacrl-reference"), board)
    html.write(Source("pretrained:gacrl-reference"), out)
    data = re.search(r'id="data">(.*?)</script>', out.read_text(encoding="utf-8"), re.DOTALL)
    assert data is not None
    exported = json.loads(data[1])
    assert exported["heard"] == 1000 and len(exported["dictionary"]) > 10
    for note in ("known", "words"):
        told = json.loads(board.notes[note])
        assert told == {"kind": note, **{name: exported[name] for name in told if name != "kind"}}


@pytest.mark.soak
def test_a_training_has_a_page_of_its_own_process():
    """It opens once there is a checkpoint, answers as any page, and ends with the training."""
    said: list[str] = []
    folder, opened = play.folder_of("pretrained:gacrl-reference"), play.open_one("pretrained:gacrl-reference")
    with page_beside("127.0.0.1", 0, {}, said.append) as watcher:
        watcher.planned(folder, opened.config, Plan(1, 1, 1, ("cpu:0",), 2, 25, ()))
        address = said[0].split()[1]
        until(lambda: said[-1].endswith("is open"), 240)
        path = address.replace("http", "ws").replace("/?", "/live?")
        with connect(path, open_timeout=60) as line:
            visitor = Visitor(line)
            visitor.scene(1, 2)
            assert visitor.frames(0, 25)[-1]["main"]["over"]
        host, port = urlsplit(address).netloc.split(":")
    with pytest.raises(OSError):
        socket.create_connection((host, int(port)), 5)
    assert len(said) == 2


def test_mistakes_end_in_a_sentence(
    said: Callable[..., tuple[int, str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reference: Site
):
    port = reference.host.rpartition(":")[2]
    empty = tmp_path / "empty"
    (empty / "checkpoints").mkdir(parents=True)
    (empty / "config.json").write_text('{"preset": "vdn", "algorithm": {"name": "vdn"}}')
    for words, sentence in (
        (("pretrained:gacrl-refrence", "--port", 0), "did you mean 'gacrl-reference'"),
        (("nobody", "--port", 0), "there is no run nobody"),
        (("oracle", "--port", port), f"cannot listen on 127.0.0.1, port {port}"),
        (("oracle", "--port", 70_000), "--port must be between 0 and 65535"),
        (("oracle", "--host", "192.0.2.1", "--port", 0), "192.0.2.1"),
        ((empty, "--port", 0), "every checkpoint in"),
        (("oracle", "random", "noop", "--port", 0), "one policy or two, not 3"),
        (("pretrained:gacrl", "pretrained:gacrl-reference", "--port", 0), "does not play spread"),
        (("told", "--port", 0), "told is no policy of spread: name its task with --env TASK"),
    ):
        code, told = said("view", *words)
        assert code == 2 and sentence in told and told.count("\n") == 1, (words, told)
    monkeypatch.setattr("gacrl.extras.find_spec", lambda name: None)
    code, told = said("train", "--view", "--out", tmp_path / "run")
    assert code == 2 and "pip install 'gacrl[view]'" in told and not (tmp_path / "run").exists()
