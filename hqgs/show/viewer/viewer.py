"""The page: what it holds and what it answers. `Viewer.pump` renders, in the thread that calls it."""

from __future__ import annotations

import html
import io
import shlex
import threading
import time
import warnings
from collections.abc import Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from hqgs.base.evenly import evenly
from hqgs.evaluation.constants import MOST_CAMERAS
from hqgs.model.formats.turned import quaternions
from hqgs.model.gaussians import Gaussians, content, orbit
from hqgs.scene.camera_files import KnownCamera, RunCameras, save_path
from hqgs.scene.paths import UP, camera_path, focus
from hqgs.scene.scene import Camera
from hqgs.show.frames import Activated
from hqgs.show.trust import Trust, has_photos, trust_of
from hqgs.show.viewer.guard import PORT, start_server
from hqgs.show.viewer.measure import Ruler
from hqgs.show.viewer.pictures import Pose, beside, same_view, shown

SHARP = 800  # px: height of a picture at rest
FREE = "(free)"
PATH_FILE = "camera_path.json"


class Client:
    """A page: what it waits for."""

    def __init__(self, handle: Any) -> None:
        self.handle = handle
        self.stale: bool = True  # what it shows is not what it should
        self.coarse: int = SHARP // 2  # px, of a picture while it moves
        self._last_move = 0.0
        self._is_sharp = False

    def moved(self) -> None:
        """Its camera has another pose."""
        self._last_move = time.monotonic()
        self.stale = True

    def waits(self) -> bool:
        """Whether it needs a picture: another one, or the same sharper."""
        return self.stale or (not self._is_sharp and self._rests())

    def begin(self) -> bool:
        """A picture for it is begun: whether a sharp one."""
        self.stale, self._is_sharp = False, self._rests()
        return self._is_sharp

    def took(self, seconds: float, height: int, sharp: bool) -> None:
        """Choose the height of the next coarse picture by the time of this one."""
        if not sharp:  # 0.06 s is what a moving picture may take, 96 px its least height
            wanted = height * (0.06 / max(seconds, 1e-3)) ** 0.5
            self.coarse = int(min(max(0.5 * (self.coarse + wanted), 96), SHARP))

    def _rests(self) -> bool:
        return time.monotonic() - self._last_move > 0.2


class Viewer:
    """A page at `url`. Call `pump` often: it renders for whoever looks, and returns if nobody waits."""

    def __init__(
        self,
        known: RunCameras | None,
        folder: Path | None,
        *,
        port: int = PORT,
        title: str = "hqgs",
        source: Path | None = None,
    ) -> None:
        """`folder`: for the camera path; `source`: what was opened, if not that. Errors: `start_server`'s."""
        self._lock = threading.RLock()
        self._known, self._folder, self._source = known, folder, source or folder
        self._views: dict[str, KnownCamera] = {} if known is None else {v.name: v for v in known.views}
        self._trust: Trust | None = None  # learned when it is first asked for
        self._gaussians: Gaussians | None = None
        self._scene: Activated | None = None  # they, ready to be rendered
        self._reach = 1.0
        self._clients: dict[int, Client] = {}
        self._keys: list[Camera] = []
        self._stats = ""
        self._server = start_server(port, title)
        self.url: str = f"http://127.0.0.1:{self._server.get_port()}"
        self._up = np.array(UP) if known is None else known.up
        self._server.scene.set_up_direction(self._up)
        self._server.scene.world_axes.visible = False
        self._build_panel()
        self._frustums = self._build_frustums()
        self._server.on_client_connect(self._connected)
        self._server.on_client_disconnect(self._disconnected)

    @property
    def watched(self) -> bool:
        """Whether a page is open."""
        return bool(self._clients)

    def set_scene(self, gaussians: Gaussians, stats: Sequence[tuple[str, str]] = ()) -> None:
        """Show these Gaussians (copied) from now on, and rows of numbers beside them."""
        copy = gaussians.like({name: t.detach().clone() for name, t in gaussians.named().items()})
        first = self._scene is None
        scene = Activated(copy)
        with self._lock:
            self._gaussians, self._scene, self._trust = copy, scene, None
            self.ruler.world = copy.world
            if first:
                self._start_view(copy)
            for client in self._clients.values():
                client.stale = True
        self._stats = _table(stats)
        self._numbers.content = self._stats

    def offer_trust(self) -> None:
        """Let pages show it, of a scene that stays as it is, where the run has photos."""
        shown = self._gaussians
        if shown is not None and (shown.errors is not None or has_photos(self._known)):
            self._show.options = (*self._show.options, "trust")

    def pump(self) -> bool:
        """Render what pages wait for; whether there was anything."""
        worked = False
        for client in list(self._clients.values()):
            if self._scene is not None and client.waits():
                self._render(client)
                worked = True
        return worked

    def serve(self, seconds: float | None = None) -> None:
        """Render until Ctrl-C, or for some seconds."""
        end = None if seconds is None else time.monotonic() + seconds
        while end is None or time.monotonic() < end:
            if not self.pump():
                time.sleep(0.01)

    def close(self) -> None:
        """Stop the server."""
        with redirect_stdout(io.StringIO()):  # viser says so
            self._server.stop()
            time.sleep(0.1)

    def _render(self, client: Client) -> None:
        pose = Pose.of(client.handle.camera)
        sharp = client.begin()
        if pose is None or self._scene is None:
            return
        height = int(self._detail.value) if sharp else client.coarse
        camera = pose.camera(height)
        started = time.perf_counter()
        try:
            asked = self._show.value == "trust"
            if asked and self._trust is None:
                self._trust = trust_of(self._scene.gaussians, self._known)
            picture = shown(self._scene, camera, self._show.value, self._trust if asked else None)
            client.took(time.perf_counter() - started, camera.height, sharp)
            picture = self._compared(picture, camera)
        except ValueError:  # a camera that no scene can be seen from, such as 1e300 away
            return
        with warnings.catch_warnings():  # of viser, where the page was closed meanwhile
            warnings.simplefilter("ignore", UserWarning)
            client.handle.scene.set_background_image(picture, format="jpeg", jpeg_quality=90 if sharp else 70)

    def _compared(self, picture: Any, camera: Camera) -> Any:
        view = self._views.get(self._photo.value)
        share = float(self._split.value)
        if view is None or view.photo is None or share <= 0:
            return picture
        if not same_view(camera, view.camera, self._reach) or not view.photo.is_file():
            return picture
        with Image.open(view.photo) as file:
            photo = np.asarray(file.convert("RGB"))
        return beside(picture, camera, photo, view.camera, share)

    def _start_view(self, gaussians: Gaussians) -> None:
        """Where a new page begins: at the first held-out or training camera, or before the scene's middle."""
        if self._views:
            cameras = [view.camera for view in self._views.values()]
            start = next((v.camera for v in self._views.values() if v.held_out), cameras[0])
            middle = focus(cameras)
            self._reach = max(float(start.viewmat[2, :3] @ (middle - start.center)), 1e-6)
        else:
            if gaussians.world.up is not None:
                self._up = np.array(gaussians.world.up)
                self._server.scene.set_up_direction(self._up)
            start = orbit(gaussians, 1, up=self._up)[0]
            middle = content(gaussians.means, gaussians.opacities)[0]
            self._reach = float(np.linalg.norm(start.center - middle))
        first = self._server.initial_camera
        first.position = start.center
        first.look_at = start.center + self._reach * start.viewmat[2, :3]
        first.fov = 2 * float(np.arctan(start.height / (2 * start.K[1, 1])))
        first.up = self._up
        first.near, first.far = 1e-3 * self._reach, 1e3 * self._reach

    def _connected(self, handle: Any) -> None:
        client = Client(handle)
        handle.camera.on_update(lambda _: client.moved())
        with self._lock:
            self._clients[handle.client_id] = client

    def _disconnected(self, handle: Any) -> None:
        with self._lock:
            self._clients.pop(handle.client_id, None)

    def _refresh(self, _: object = None) -> None:
        for client in list(self._clients.values()):
            client.stale = True

    def _build_panel(self) -> None:
        gui = self._server.gui
        self._numbers = gui.add_markdown(self._stats)
        with gui.add_folder("Picture"):
            self._show: Any = gui.add_dropdown("Show", ("color", "depth", "alpha"))
            self._detail = gui.add_slider("Height, px", 200, 1600, 50, SHARP, hint="of the sharp picture")
        with gui.add_folder("Photos", visible=bool(self._views)):
            names = [v.name for v in sorted(self._views.values(), key=lambda v: not v.held_out)]
            self._photo = gui.add_dropdown("Camera", (FREE, *names))
            self._split = gui.add_slider("Photo | render", 0.0, 1.0, 0.01, 0.5)
            self._cameras_box = gui.add_checkbox("Show cameras", False)
        with gui.add_folder("Camera path", expand_by_default=False):
            add, drop = gui.add_button("Add this view"), gui.add_button("Remove the last")
            self._length = gui.add_slider("Seconds", 1, 60, 1, 8)
            play, keep = gui.add_button("Play"), gui.add_button("Save")
            self._told = gui.add_markdown("No view yet.")
        self.ruler: Ruler = Ruler(self._server, lambda: self._scene)
        for handle in (self._show, self._detail, self._split):
            handle.on_update(self._refresh)
        self._photo.on_update(self._go_to_photo)
        self._cameras_box.on_update(self._toggle_cameras)
        add.on_click(self._add_key)
        drop.on_click(self._drop_key)
        play.on_click(self._play)
        keep.on_click(self._save)

    def _build_frustums(self) -> list[Any]:
        made = []
        views = [*self._views.values()]
        chosen = evenly(len(views), MOST_CAMERAS)
        extent = np.linalg.norm(np.ptp([v.camera.center for v in views], axis=0)) if views else 1.0
        for k in chosen:
            view, image = views[k], None
            if view.photo is not None and view.photo.is_file():
                with Image.open(view.photo) as file:
                    file.thumbnail((160, 160))
                    image = np.asarray(file.convert("RGB"))
            camera = view.camera
            handle = self._server.scene.add_camera_frustum(
                f"/cameras/{k}",
                fov=2 * float(np.arctan(camera.height / (2 * camera.K[1, 1]))),
                aspect=camera.width / camera.height,
                scale=0.04 * float(extent) or 0.1,
                thickness=1.5,
                thickness_units="screen",
                color=(220, 120, 40) if view.held_out else (60, 140, 220),
                image=image,
                wxyz=quaternions(camera.viewmat[None, :3, :3].swapaxes(1, 2))[0],
                position=camera.center,
                visible=False,
            )
            handle.on_click(lambda _, name=view.name: setattr(self._photo, "value", name))
            made.append(handle)
        return made

    def _toggle_cameras(self, _: object) -> None:
        for handle in self._frustums:
            handle.visible = self._cameras_box.value

    def _go_to_photo(self, _: object) -> None:
        view = self._views.get(self._photo.value)
        if view is not None:
            for client in list(self._clients.values()):
                self._fly(client, view.camera)
        self._refresh()

    def _fly(self, client: Client, camera: Camera) -> None:
        handle = client.handle.camera
        R = camera.viewmat[:3, :3]
        with client.handle.atomic():
            handle.up_direction = -R[1]
            handle.position = camera.center
            handle.look_at = camera.center + self._reach * R[2]
            handle.fov = 2 * float(np.arctan(camera.height / (2 * camera.K[1, 1])))

    def _add_key(self, event: Any) -> None:
        pose = None if event.client is None else Pose.of(event.client.camera)
        if pose is not None:
            self._keys.append(pose.camera(720))
        self._tell()

    def _drop_key(self, _: object) -> None:
        if self._keys:
            self._keys.pop()
        self._tell()

    def _path(self) -> list[Camera]:
        """Of 30 frames per second and one size, with even sides, as films need."""
        frames = camera_path(self._keys, 30 * int(self._length.value), sort=False)
        return [Camera(c.width - c.width % 2, c.height, c.K, c.viewmat) for c in frames]

    def _play(self, event: Any) -> None:
        client = None if event.client is None else self._clients.get(event.client.client_id)
        if client is None or len(self._keys) < 2:
            self._tell("Add two views first.")
            return
        for camera in self._path()[::3]:
            self._fly(client, camera)
            time.sleep(0.1)

    def _save(self, _: object) -> None:
        if not self._keys:
            self._tell("Add a view first.")
        elif self._folder is None:
            self._tell("This scene has no folder to save the path in.")
        else:
            path = self._folder / PATH_FILE
            shown = self._gaussians
            frame = {} if shown is None else {"world": shown.world, "by": shown.moved}
            try:
                save_path(path, self._path(), **frame)
            except OSError as error:
                return self._tell(f"Not saved: {error}")
            command = ["hqgs", "render", str(self._source), "--path", str(path), "--out", "path.mp4"]
            self._tell(f"Saved. `{shlex.join(command)}`")

    def _tell(self, text: str = "") -> None:
        views = f"{len(self._keys)} view{'' if len(self._keys) == 1 else 's'}."
        self._told.content = f"{views} {text}"


def _table(rows: Sequence[tuple[str, str]]) -> str:
    """Markdown; names of files, and reports of others' runs, may hold what it takes for HTML or a table."""
    cells = ([html.escape(cell).replace("|", "&#124;").replace("\n", " ") for cell in row] for row in rows)
    lines = (f"| {name} | {value} |" for name, value in cells)
    return "\n".join(["| | |", "|---|---|", *lines])
