"""Training: one step from top to bottom, and the state that a checkpoint keeps."""

from __future__ import annotations

import math
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hqgs.base.left_out import LeftOut
from hqgs.base.threads import one_torch_thread
from hqgs.diagnosis.choice import choose_photos
from hqgs.evaluation.held_out import RenderedView
from hqgs.evaluation.metrics import psnr, ssim
from hqgs.model.gaussians import Gaussians
from hqgs.model.render import render_view
from hqgs.scene.scene import Camera, Scene, View
from hqgs.training.adam import Adam
from hqgs.training.checkpoint import load_checkpoint, save_checkpoint, scene_fingerprint
from hqgs.training.config import TrainConfig
from hqgs.training.densify import Densifier
from hqgs.training.frugality import Frugality
from hqgs.training.guard import LISTED, Event, Guard, bad_rows, bad_values, is_sound
from hqgs.training.methods import make_method

MAX_SKIPPED_IN_A_ROW = 20  # steps; one bad view may pass, a broken run should not go on for hours
FREE_FIELDS = ("eval_every", "checkpoint_every")  # may differ on resume: they do not change the result


class TrainingError(RuntimeError):
    """The training cannot go on; the message says why and at which iteration."""


@dataclass(frozen=True)
class Step:
    """What a training step has seen."""

    loss: float
    render: Tensor  # [H, W, 3], detached
    view: View


class Trainer:
    """The state of a run. The view of a step, its learning rates and its SH degree follow from the
    configuration and the iteration, so that they need no state."""

    def __init__(self, scene: Scene, config: TrainConfig) -> None:
        """ValueError if the scene or the configuration cannot be trained."""
        _check_views(scene)
        self.photos_left_out: list[LeftOut] = []
        if "photos" in config.leave_out:
            scene, self.photos_left_out = choose_photos(scene)
        self.scene = scene
        self.extent = scene.extent
        self.method = make_method(scene, config)
        self.config = config = self.method.adapt(config)
        self.frugality = Frugality(config, scene.train, self.method)
        points = self.method.first_points(scene, config)
        self.first_points = len(points[0])
        self.gaussians = Gaussians.from_points(*points, config.sh_degree)
        self.optimizer = self._make_optimizer()
        self.densifier = Densifier(config.densify, self.extent, scene.reach, config.seed, len(self.gaussians))
        self.iteration = 0  # steps done
        self.seconds = 0.0  # spent in steps
        self.guard = Guard()
        self.history: list[dict[str, Any]] = []

    @property
    def length(self) -> int:
        """Iterations of the run, as far as it is known: those of the configuration, or fewer."""
        return self.frugality.length

    def step(self) -> Step:
        """Train on one view."""
        started = time.perf_counter()
        config = self.config
        self.densifier.reset(self.iteration, self.gaussians, self.optimizer)
        self.iteration += 1
        view = self.frugality.view(self.iteration)
        self._set_rates()

        with one_torch_thread():
            render, meta = self._render(view.camera)
            means2d = meta["means2d"]  # [1, N, 2]
            means2d.retain_grad()
            loss = self.method.loss(render, view)
            self.optimizer.zero_grad()
            if self._backward(loss, render, view):
                if self.iteration < self.densifier.config.stop:
                    self.densifier.observe(
                        means2d.grad[0], meta["radii"][0], view.camera.width, view.camera.height
                    )
                # Methods' own tensors have no row for each Gaussian: all of them are updated.
                visible = (meta["radii"][0] > 0).all(dim=1) if config.selective_adam else None
                self.optimizer.step(visible=visible)
            finest = self.frugality.finest(self.iteration)
            growth = self.densifier.update(self.iteration, self.gaussians, self.optimizer, finest)
            changed = bool(growth.cloned or growth.split or growth.pruned)
            if changed:
                self.method.rows_changed()
            self._check_parameters(view, changed)
            self.frugality.after_step(self, growth, time.perf_counter() - started)

        if not len(self.gaussians):
            raise TrainingError(
                f"no Gaussians are left at iteration {self.iteration}: all were pruned as transparent, too "
                f"large (scene's reach {self.densifier.reach:.3g}) or not finite ({self.guard.culled}); are "
                "the cameras and points in one frame?"
            )
        self.seconds += time.perf_counter() - started
        return Step(float(loss.detach()), render.detach(), view)

    def remove(self, rows: Tensor) -> None:
        """Remove the Gaussians of these rows, bool [N]."""
        self.densifier.remove(rows, self.gaussians, self.optimizer)
        self.method.rows_changed()

    def render_test_views(self) -> list[RenderedView]:
        """All held-out views with their renders [H, W, 3]."""
        views = []
        with one_torch_thread(), torch.no_grad():
            for view in self.scene.test:
                render, meta = self._render(view.camera)
                culled = int((meta["radii"][0] == 0).any(dim=1).sum())
                views.append(RenderedView(view.name, view.image, render.numpy(), view.mask, culled))
        return views

    def evaluate(self) -> None:
        """Add the held-out means at this iteration to the history, once. Takes no training time."""
        if self.history and self.history[-1]["iteration"] == self.iteration:
            return
        views = self.render_test_views()
        entry: dict[str, Any] = {"iteration": self.iteration, "seconds": self.seconds}
        for name, metric in {"psnr": psnr, "ssim": ssim}.items():
            values = [metric(v.render, v.photo, v.mask) for v in views]
            known = [value for value in values if value is not None]
            entry[name] = float(np.mean(known)) if known and len(known) == len(values) else None
        self.history.append(entry)

    def save(self, path: str | Path) -> None:
        """Write the whole state as one checkpoint, atomically."""
        tensors = {f"gaussians.{name}": tensor for name, tensor in self.gaussians.named().items()}
        tensors |= {f"densify.{name}": tensor for name, tensor in self.densifier.state_dict().items()}
        tensors |= {f"method.{name}": tensor for name, tensor in self.method.state_dict().items()}
        for group in self.optimizer.param_groups:
            for i, param in enumerate(group["params"]):
                for key, value in self.optimizer.state.get(param, {}).items():
                    tensors[f"adam.{group['name']}.{i}.{key}"] = torch.as_tensor(value)
        meta = {
            "iteration": self.iteration,
            "seconds": self.seconds,
            "history": self.history,
            "guard": asdict(self.guard),
            "frugality": self.frugality.state_dict(),
            "config": asdict(self.config),
            "scene": scene_fingerprint(self.scene),
        }
        save_checkpoint(path, tensors, meta)

    def restore(self, path: str | Path) -> None:
        """Go on from a checkpoint, bit for bit.

        ValueError for a damaged one, or one of another run; it names the field in which that differs.
        """
        tensors, meta = load_checkpoint(path)
        try:
            self._take_over(path, tensors, meta)
        except (KeyError, TypeError, AttributeError, RuntimeError) as error:
            raise ValueError(f"{path} is no whole checkpoint of a run: {error!r}") from error

    def _take_over(self, path: str | Path, tensors: dict[str, Tensor], meta: dict[str, Any]) -> None:
        lists = {name: list(getattr(self.config, name)) for name in ("background", "leave_out")}
        here = asdict(self.config) | lists
        # The scene first: methods fit the configuration to it.
        _check_same(path, "scene ", meta["scene"], scene_fingerprint(self.scene))
        _check_same(path, "", meta["config"], here)

        def part(prefix: str) -> dict[str, Tensor]:
            return {n.removeprefix(prefix): t for n, t in tensors.items() if n.startswith(prefix)}

        def check(name: str, tensor: Tensor, like: Tensor) -> None:
            if tensor.shape != like.shape or tensor.dtype != like.dtype:
                raise ValueError(
                    f"{path} is damaged: {name} is {tensor.dtype} {list(tensor.shape)}, "
                    f"wanted {like.dtype} {list(like.shape)}"
                )

        self.frugality.load_state_dict(meta["frugality"])
        n = len(tensors["gaussians.means"])
        for name, tensor in self.gaussians.named().items():
            row = tensor.shape[1:] if name != "shN" else (self.frugality.num_higher, 3)
            check(name, tensors[f"gaussians.{name}"], tensor.new_empty((n, *row)))
        self.gaussians = Gaussians(**part("gaussians."))
        self.method.load_state_dict(part("method."))
        self.optimizer = self._make_optimizer()
        for group in self.optimizer.param_groups:
            for i, param in enumerate(group["params"]):
                if state := part(f"adam.{group['name']}.{i}."):
                    for key in ("exp_avg", "exp_avg_sq"):
                        check(f"{key} of {group['name']}", state[key], param)
                    check(f"step of {group['name']}", state["step"], torch.tensor(0.0))
                    self.optimizer.state[param] = state
        for name, tensor in part("densify.").items():
            check(f"densify.{name}", tensor, torch.empty(n))
        self.densifier.load_state_dict(part("densify."))
        self.densifier.config = self.frugality.densify_config
        for name in ("iteration", "seconds", "history"):
            setattr(self, name, meta[name])
        self.guard = Guard(**meta["guard"])

    def _make_optimizer(self) -> Adam:
        groups: list[dict[str, Any]] = [
            {"name": name, "params": [tensor.requires_grad_()]}  # `_set_rates` has their rates
            for name, tensor in self.gaussians.named().items()
        ]
        own = [group | {"every_row": True} for group in self.method.param_groups()]
        return Adam(groups + own, lr=0.0, eps=self.config.adam_eps)

    def _active_degree(self) -> int:
        """Of the harmonics: it rises with the iterations."""
        return min(self.gaussians.sh_degree, self.frugality.degree(self.iteration))

    def _set_rates(self) -> None:
        """As far as the method leaves them; the means' decay exponentially over the run. Harmonics above the
        degree in use, which never had a gradient, are left out of Adam."""
        config, left = self.config, self.method.rate_left
        part = self.frugality.part(self.iteration)
        groups = {group["name"]: group for group in self.optimizer.param_groups}
        for name in self.gaussians.named():
            groups[name]["lr"] = left * getattr(config, f"lr_{name}")
        means = self.extent * config.lr_means ** (1 - part) * config.lr_means_final**part
        groups["means"]["lr"] = left * means
        groups["shN"]["used"] = (self._active_degree() + 1) ** 2 - 1

    def _render(self, camera: Camera) -> tuple[Tensor, dict[str, Any]]:
        gaussians = self.method.modulate(self.gaussians)
        return render_view(gaussians, camera, self._active_degree(), self.config.background)

    def _backward(self, loss: Tensor, render: Tensor, view: View) -> bool:
        """Compute the gradients. Where the loss or a gradient is not finite: False, and the guard knows.

        Gaussians whose gradient is not finite are removed. They are not at fault where the gradient of the
        loss with respect to the render is not finite already: that comes from the view.
        """
        guard = self.guard
        finite = math.isfinite(loss.detach())
        if finite:
            render.retain_grad()
            loss.backward()
            finite = self._check_gradients(render, view)
        elif count := bad_values(view):
            guard.add(Event(self.iteration, view.name, "photo", [], count, []))
        else:
            guard.add(Event(self.iteration, view.name, "loss", [], 0, []))
        guard.skipped += not finite
        guard.skipped_in_a_row = 0 if finite else guard.skipped_in_a_row + 1
        if guard.skipped_in_a_row >= MAX_SKIPPED_IN_A_ROW:
            raise TrainingError(
                f"the loss or a gradient was not finite in {guard.skipped_in_a_row} steps in a row, up to "
                f"iteration {self.iteration}; the last loss is {float(loss.detach())}, of view {view.name!r}"
            )
        return finite

    def _check_gradients(self, render: Tensor, view: View) -> bool:
        """Whether all gradients are finite. If not, the Gaussians at fault are removed."""
        # shN, three quarters of the numbers, is left out: its gradient is sh0's times a bounded basis.
        # A method may leave a tensor without a gradient.
        named = {n: t.grad for n, t in self.gaussians.named().items() if n != "shN" and t.grad is not None}
        others = [
            (group["name"], param.grad)
            for group in self.optimizer.param_groups
            if group.get("every_row")
            for param in group["params"]
            if param.grad is not None
        ]
        if all(map(is_sound, (*named.values(), *(grad for _, grad in others)))):
            return True
        if render.grad is not None and not torch.isfinite(render.grad).all():
            self.guard.add(Event(self.iteration, view.name, "gradient", ["render"], 0, []))
            return False
        names, rows = bad_rows(self.gaussians.named())
        if names:  # which is why: the activations pass NaN on
            self._cull(view, "parameter", names, rows)
            return False
        names, rows = bad_rows(named)
        names += [name for name, grad in others if not torch.isfinite(grad).all()]
        if names:
            self._cull(view, "gradient", names, rows)
        return not names

    def _check_parameters(self, view: View, changed: bool) -> None:
        """Remove the Gaussians with a value that is not finite. shN is looked at after a change of rows: its
        gradients are finite, so nothing else can spoil it."""
        named = {n: t for n, t in self.gaussians.named().items() if n != "shN" or changed}
        if not all(map(is_sound, named.values())):
            names, rows = bad_rows(self.gaussians.named())
            if names:
                self._cull(view, "parameter", names, rows)

    def _cull(self, view: View, what: str, names: list[str], rows: Tensor) -> None:
        """Remove the Gaussians of these rows, bool [N], and note where they were not finite."""
        indices = torch.nonzero(rows)[:, 0]
        listed = indices[:LISTED].tolist()
        self.guard.add(Event(self.iteration, view.name, what, names, len(indices), listed))
        if len(indices):
            self.remove(rows)
            self.guard.culled += len(indices)


def _check_views(scene: Scene) -> None:
    if not scene.train:
        raise ValueError(f"scene {scene.name!r} has no training views")
    for view in [*scene.train, *scene.test]:
        wanted = (view.camera.height, view.camera.width, 3)
        if view.image.dtype not in (np.uint8, np.float32) or view.image.shape != wanted:
            raise ValueError(
                f"view {view.name!r}: the image is {view.image.dtype} {list(view.image.shape)}, "
                f"its camera wants uint8 or float32 {list(wanted)}"
            )


def _check_same(path: str | Path, prefix: str, saved: dict[str, Any], here: dict[str, Any]) -> None:
    """ValueError for the first field that differs; nested fields are named with dots."""
    if not isinstance(saved, dict):
        raise ValueError(f"{path} is damaged: {prefix or 'config'} is {saved!r:.80}")
    for name in here | saved:
        old, new = saved.get(name), here.get(name)
        if isinstance(old, dict) and isinstance(new, dict):
            _check_same(path, f"{prefix}{name}.", old, new)
        elif old != new and name not in FREE_FIELDS:
            raise ValueError(
                f"{path} was made with another {prefix}{name}: {old!r} there, {new!r} in this run; "
                "use the same one, or another folder"
            )
