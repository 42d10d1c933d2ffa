"""The page of `hqgs view`: what it shows, in a browser, and whom it answers."""

from __future__ import annotations

import http.client
import io
import math
import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from browser import PATIENCE, chromium, wait
from PIL import Image
from tiny_scene import HEIGHT, WIDTH, tiny_config, tiny_scene

import hqgs
from hqgs.cli import main as cli
from hqgs.cli import view
from hqgs.scene import source
from hqgs.scene.camera_files import load_cameras, load_path
from hqgs.scene.paths import with_size
from hqgs.show.frames import trust_picture
from hqgs.show.trust import learn_trust
from hqgs.show.viewer import guard
from hqgs.show.viewer.guard import MAX_MESSAGE, allowed, start_server
from hqgs.show.viewer.pictures import Pose, beside, same_view
from hqgs.show.viewer.viewer import Viewer, _table


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("run")
    hqgs.train(tiny_scene(), out=out, iterations=200, method="3dgs", leave_out="none")
    return out


@contextmanager
def serving(folder: Path) -> Iterator[Viewer]:
    """A viewer whose pictures are rendered in another thread, as the test drives the browser in this one."""
    viewer = Viewer(load_cameras(folder), folder, port=0)
    viewer.set_scene(hqgs.Gaussians.load(folder), [("Gaussians", "many")])
    done = threading.Event()

    def work() -> None:
        while not done.is_set():
            viewer.serve(0.1)

    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield viewer
    finally:
        done.set()
        thread.join()
        viewer.close()


# --- who is answered


@pytest.mark.parametrize(
    ("host", "origin", "right"),
    [
        ("127.0.0.1:8080", None, True),
        ("localhost:8080", "http://localhost:8080", True),
        ("[::1]:9", "http://[::1]:9", True),
        ("127.0.0.1:8080", "http://evil.example", False),
        ("127.0.0.1:8080", "http://127.0.0.1:8081", False),
        ("127.0.0.1:8080", "https://127.0.0.1:8080", False),
        ("127.0.0.1:8080", "null", False),
        ("127.0.0.1:8080", "", False),
        ("evil.example:8080", "http://evil.example:8080", False),
        ("127.0.0.1.evil.example", None, False),
        ("localhost:8080@evil.example", None, False),
        (None, None, False),
    ],
)
def test_pages_of_this_machine_alone(host: str | None, origin: str | None, right: bool) -> None:
    assert allowed(host, origin) == right


def ask(port: int, path: str, **headers: str) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    connection.putrequest("GET", path, skip_host=True)
    for name, value in {"Host": f"127.0.0.1:{port}", **headers}.items():
        connection.putheader(name, value)
    connection.endheaders()
    answer = connection.getresponse()
    return answer.status, answer.read()


UPGRADE = {
    "Upgrade": "websocket",
    "Connection": "Upgrade",
    "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
    "Sec-WebSocket-Version": "13",
}


def test_strangers_huge_messages_and_paths_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    import viser
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.client import connect
    from websockets.typing import Origin

    server = start_server(port=0)
    port = server.get_port()
    try:
        assert capsys.readouterr().out == ""
        assert ask(port, "/")[0] == 200
        secret = os.path.relpath("/etc/hostname", viser.__path__[0])
        for path in (
            "/../../_viser.py",
            "/%2e%2e/%2e%2e/_viser.py",
            "/..%5c..%5c_viser.py",
            f"/{secret}",
            "//etc/hostname",
        ):
            assert ask(port, path)[0] in (400, 404), path
        assert ask(port, "/", Host="evil.example")[0] == 403
        assert ask(port, "/", Origin="http://evil.example")[0] == 403
        assert ask(port, "/", Origin="http://evil.example", **UPGRADE)[0] == 403
        assert (
            ask(port, "/", Host=f"evil.example:{port}", Origin=f"http://evil.example:{port}", **UPGRADE)[0]
            == 403
        )
        assert ask(port, "/", **UPGRADE)[0] == 101
        # Only this machine's own address hears.
        with pytest.raises(OSError, match="refused"):
            socket.create_connection(("127.0.0.2", port), timeout=5)
        # A message that is too large ends its connection, and junk no other.
        here, ours = f"ws://127.0.0.1:{port}", Origin(f"http://127.0.0.1:{port}")
        protocol: Any = [f"viser-v{viser.__version__}"]
        junk = (os.urandom(5000), b"", b"\x81\xa4type\xa4junk", b"\xdd\xff\xff\xff\xff")
        for message in (b"\0" * (MAX_MESSAGE + 1), *junk):
            ended = None
            with connect(here, subprotocols=protocol, max_size=None, origin=ours) as page:
                page.recv(timeout=10)
                try:
                    page.send(message)
                    while True:
                        page.recv(timeout=1)
                except ConnectionClosed as error:
                    ended = error.rcvd
                except TimeoutError:
                    pass
            if len(message) > MAX_MESSAGE:
                assert ended is not None
                assert ended.code == 1009  # too big
            assert ask(port, "/")[0] == 200
        assert server.request_share_url() is None
    finally:
        server.stop()


# --- the pictures


def handle(**values: Any) -> SimpleNamespace:
    known = {"wxyz": (1, 0, 0, 0), "position": (0, 0, 0), "fov": 1.0, "image_width": 40, "image_height": 30}
    return SimpleNamespace(**known | values)


def test_poses_of_pages() -> None:
    pose = Pose.of(handle(wxyz=(math.sqrt(2), 0, math.sqrt(2), 0), position=(1, 2, 3)))
    assert pose is not None
    camera = pose.camera(60)
    np.testing.assert_allclose(camera.viewmat[2, :3], [1, 0, 0], atol=1e-9)  # turned about y: looks along x
    np.testing.assert_allclose(camera.center, [1, 2, 3], atol=1e-9)
    assert (camera.width, camera.height) == (80, 60)
    assert 2 * math.atan(30 / camera.K[1, 1]) == pytest.approx(1.0)
    assert pose.camera(10**9).height <= 2048
    bad = [{"wxyz": (0, 0, 0, 0)}, {"wxyz": (math.nan,) * 4}, {"position": (math.inf, 0, 0)}, {"fov": 0}]
    for values in [*bad, {"fov": 4}, {"image_width": 0}, {"image_width": 1e9}]:
        assert Pose.of(handle(**values)) is None


def test_a_photo_lies_where_its_pixels_belong() -> None:
    """A page twice as wide, with twice the focal length: the photo's middle half is scaled by two."""
    scene = tiny_scene()
    taken, photo = scene.train[0].camera, scene.train[0].image.astype(np.uint8)
    page = with_size(taken, 2 * WIDTH, 2 * HEIGHT)
    picture = np.zeros((2 * HEIGHT, 2 * WIDTH, 3), np.uint8)
    full = beside(picture, page, photo, taken, 1.0)
    assert np.abs(full[8:-8:2, 8:-8:2].astype(float) - photo[4:-4, 4:-4]).mean() < 8
    half = beside(picture, page, photo, taken, 0.5)
    assert np.array_equal(half[:, : WIDTH - 2], full[:, : WIDTH - 2])
    assert (half[:, WIDTH:] == 0).all()
    assert not beside(picture, page, photo, taken, 0.0).any()
    small = np.ascontiguousarray(photo[::2, ::2])
    near = beside(picture, page, small, taken, 1.0)
    assert np.abs(near[6:-6, 6:-6].astype(float) - full[6:-6, 6:-6]).mean() < 20
    assert same_view(page, taken, 3.0)
    assert not same_view(page, scene.train[1].camera, 3.0)


# --- in a browser


def until(true: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE
    while not true():
        assert time.monotonic() < end
        time.sleep(0.05)


def expected(model: hqgs.Gaussians, camera: hqgs.Camera) -> np.ndarray:
    with torch.no_grad():
        return (255 * model.render(camera).clamp(0, 1)).byte().numpy()


def test_the_page_in_a_browser(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    known, model = load_cameras(folder), hqgs.Gaussians.load(folder)
    with serving(folder) as viewer, chromium(600, 400) as (page, wrong):
        page.goto(viewer.url)
        wait(page, "document.querySelector('canvas') && document.body.innerText.includes('Show cameras')")

        def shown(other: np.ndarray | float = -1.0) -> np.ndarray:
            """The middle of the page, without panels, once it is at rest and not what was there before."""
            before = b""
            while True:
                time.sleep(0.4)
                now = page.screenshot()
                found = np.asarray(Image.open(io.BytesIO(now)).convert("RGB"), float)[190:395, 5:270]
                if (now == before and not np.array_equal(found, other)) or time.monotonic() > end:
                    return found
                before = now

        end = time.monotonic() + 2 * PATIENCE

        until(lambda: viewer.watched)
        (client,) = viewer._clients.values()
        # What it shows is what the rasterizer renders from there.
        seen = shown()
        pose = Pose.of(client.handle.camera)
        assert pose is not None
        np.testing.assert_allclose(pose.position, known.test[0].center, atol=1e-3)
        ours = expected(model, pose.camera(400))[190:395, 5:270]
        assert ours.std() > 15
        assert np.abs(seen - ours).mean() < 6
        # The mouse moves the camera, and another picture comes.
        page.mouse.move(150, 250)
        page.mouse.down()
        page.mouse.move(190, 260, steps=4)
        page.mouse.up()
        turned = shown(seen)
        assert np.abs(turned - seen).mean() > 2
        # A photo beside its render, by the slider.
        view = known.views[0]
        viewer._split.value = 1.0
        viewer._photo.value = view.name
        photo = shown(turned)
        np.testing.assert_allclose(client.handle.camera.position, view.camera.center, atol=1e-3)
        viewer._split.value = 0.0
        render = shown(photo)
        pose = Pose.of(client.handle.camera)
        assert pose is not None
        camera = pose.camera(400)
        assert view.photo is not None
        over = beside(expected(model, camera), camera, np.asarray(Image.open(view.photo)), view.camera, 1.0)
        assert np.abs(photo - over[190:395, 5:270]).mean() < 6
        assert np.abs(render - expected(model, camera)[190:395, 5:270]).mean() < 6
        assert np.abs(photo - render).mean() > 6
        # Depth.
        viewer._show.value = "depth"
        depth = shown(render)
        assert np.abs(depth - render).mean() > 15
        # What the photos say of it.
        viewer.offer_trust()
        viewer._show.value = "trust"
        picture = trust_picture(learn_trust(model, known).bound(camera))[190:395, 5:270]
        assert np.abs(shown(depth) - picture).mean() < 10  # JPEG blurs such colours
        assert np.abs(depth - picture).mean() > 15
        assert [text for text in wrong if "deprecated" not in text] == []
        assert str(viewer._numbers.content).endswith("| Gaussians | many |")


def test_a_strangers_report_is_text_in_the_page() -> None:
    told = _table([("a|b", "<iframe srcdoc='x'>\n"), ("noise", "7 levels")])
    assert "<iframe" not in told
    assert told.splitlines()[2:] == [
        "| a&#124;b | &lt;iframe srcdoc=&#x27;x&#x27;&gt;  |",
        "| noise | 7 levels |",
    ]


def test_a_path_that_was_made_in_the_page_is_rendered(folder: Path, tmp_path: Path) -> None:
    with serving(folder) as viewer:
        viewer._save(None)
        assert "Add a view first" in viewer._told.content
        for number in range(3):
            at = handle(position=(0.2 * number, 0, 0), image_width=48, image_height=32)
            viewer._add_key(SimpleNamespace(client=SimpleNamespace(camera=at)))
        viewer._drop_key(None)
        viewer._length.value = 1
        viewer._save(None)
        assert "2 views. Saved." in viewer._told.content
        assert (
            f"`hqgs render {folder} --path {folder}/camera_path.json --out path.mp4`" in viewer._told.content
        )
        viewer._folder = folder / "gone"
        (folder / "gone").write_text("a file")
        viewer._save(None)
        assert "2 views. Not saved: " in viewer._told.content
    cameras, fps = load_path(folder / "camera_path.json")
    assert (len(cameras), fps, cameras[0].height) == (30, 30, 720)
    np.testing.assert_allclose([cameras[0].center[0], cameras[-1].center[0]], [0, 0.2], atol=1e-6)
    arguments = [
        "--path",
        str(folder / "camera_path.json"),
        "--size",
        "48",
        "32",
        "--out",
        str(tmp_path / "a.gif"),
    ]
    assert cli.main(["render", str(folder), *arguments]) == 0


# --- the commands


def test_view_ends_by_itself_and_says_where_to_look(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert view.run(view.ViewOptions(source=folder, port=0), seconds=0.1) == 0
    assert signal.getsignal(signal.SIGTERM) is signal.default_int_handler  # pycolmap's prints a stack trace
    assert "open http://127.0.0.1:" in capsys.readouterr().out
    bare = tmp_path / "a b" / "bare.ply"
    hqgs.Gaussians.load(folder).save(bare)

    def save(page: Viewer, _: float | None = None) -> None:
        page._add_key(SimpleNamespace(client=SimpleNamespace(camera=handle(image_width=48, image_height=32))))
        page._save(None)
        told.append(page._told.content)

    told: list[str] = []
    monkeypatch.setattr(Viewer, "serve", save)
    assert view.run(view.ViewOptions(source=bare, port=0)) == 0
    assert f"`hqgs render '{bare}' --path '{bare.parent}/camera_path.json' --out path.mp4`" in told[0]
    assert cli.main(["view", str(tmp_path / "nothing")]) == 2
    assert "there is no" in capsys.readouterr().err


def test_without_viser_the_extra_is_named_before_anything_is_done(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["train", "embedded", "--out", str(tmp_path / "a"), "--view", "--port", "70000"]) == 2
    assert "port is 70000" in capsys.readouterr().err
    monkeypatch.setattr(guard, "find_spec", lambda name: None)
    for command in (["view", str(folder)], ["train", "embedded", "--out", str(tmp_path / "a"), "--view"]):
        assert cli.main(command) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line == "hqgs: the viewer needs viser, the extra 'view': pip install 'hqgs[view]'"
    assert not (tmp_path / "a").exists()


def test_train_shows_its_page_and_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def end(page: Viewer, seconds: float | None = None) -> None:
        shown.append(page._scene is not None)
        raise KeyboardInterrupt

    shown: list[bool] = []

    monkeypatch.setattr(source, "embedded_scene", lambda *_: tiny_scene())
    monkeypatch.setattr(Viewer, "serve", end)
    command = ["train", "embedded", "--out", str(tmp_path), "--iterations", "3", "--view", "--port", "0"]
    assert cli.main(command) == 0
    told = capsys.readouterr().out
    assert told.count("open http://127.0.0.1:") == 2
    assert "next, to see it" not in told
    assert cli.main([*command, "--resume"]) == 0  # without a step
    assert shown == [True, True]


def test_looking_on_does_not_change_a_run(tmp_path: Path) -> None:
    scene = tiny_scene()
    alone = hqgs.train(scene, config=tiny_config())
    live = view.LiveView(scene, tmp_path / "missing", port=0)
    assert not any(tmp_path.iterdir())  # the folder is the run's
    try:
        live.viewer._clients[0] = Looking()  # type: ignore[assignment]
        watched = hqgs.train(scene, config=tiny_config(), progress=live)
        assert Looking.pictures > 5
        assert live.viewer._scene is not None
        shown = torch.from_numpy(live.viewer._scene._arrays[0])  # neighbours together
        assert torch.equal(shown.sort(dim=0).values, watched.model.means.sort(dim=0).values)
    finally:
        live.viewer.close()
    for name, tensor in alone.model.named().items():
        assert torch.equal(tensor, watched.model.named()[name]), name


class Looking:
    """A page that wants a picture after each step."""

    pictures = 0
    stale = True
    coarse = 16

    def __init__(self) -> None:
        self.handle = SimpleNamespace(camera=handle(position=(0, 0, 0)), scene=self)

    def waits(self) -> bool:
        return True

    def begin(self) -> bool:
        return False

    def took(self, *_: Any) -> None:
        pass

    def set_background_image(self, picture: np.ndarray, **_: Any) -> None:
        assert picture.ndim == 3
        Looking.pictures += 1


def test_those_whose_browser_is_elsewhere_are_told_how(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from hqgs.cli import view
    from hqgs.show.viewer.guard import REFUSED

    monkeypatch.setenv("SSH_CONNECTION", "10.0.0.1 5000 10.0.0.2 22")
    view._tell("http://127.0.0.1:8123", False)
    assert "ssh -L 8123:localhost:8123" in capsys.readouterr().out
    for words in ("http://localhost:8123", "ssh -L 8123:localhost:8123", "VS Code", "Docker", "JupyterHub"):
        assert words in REFUSED.format(port=8123)
    monkeypatch.delenv("SSH_CONNECTION")
    monkeypatch.setattr(view, "elsewhere", lambda: False)
    view._tell("http://127.0.0.1:8123", False)
    assert "ssh" not in capsys.readouterr().out
