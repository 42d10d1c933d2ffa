"""What a run is planned from, found once: facts, diagnosis, and what renders are compared with."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from hqgs.base.left_out import LeftOut
from hqgs.base.threads import one_torch_thread
from hqgs.diagnosis.choice import choose_photos
from hqgs.diagnosis.scene import Diagnosis, Inspector
from hqgs.model.first_points import Agreement, Colors, Points, points_along_edges
from hqgs.model.gaussians import Gaussians
from hqgs.model.shapes import as_discs
from hqgs.scene.scene import Scene
from hqgs.training.config import AUTO, FORMATION, TrainConfig
from hqgs.training.forward import TrainingViews
from hqgs.training.frame import Frame, Trainable, with_rounded_poses
from hqgs.training.methods import MAKERS
from hqgs.training.methods.base import Method
from hqgs.training.plan import Facts, RunPlan, StepSeconds
from hqgs.training.rules import OF_PHOTOS_ALONE, RULES, growth_in_doubt, plan_run
from hqgs.training.trial import Begin, calls_for_trial, tried_growth, tried_looks


class Prepared:
    """A scene on which a run was asked for, looked at; plans are made from its facts."""

    def __init__(
        self,
        scene: Trainable,
        asked: TrainConfig,
        inspector: Inspector | None = None,
        begin: Begin | None = None,
    ) -> None:
        """`inspector`: what looks at the photos; `begin` makes trainers of short runs that try what pays,
        None: nothing is tried. ValueError if the scene cannot be trained."""
        self._frame: Frame | None = scene if isinstance(scene, Frame) else None
        scene = scene.scene() if isinstance(scene, Frame) else scene
        scene.check_trainable()
        if (most := asked.densify.max_gaussians) < len(scene.points):
            raise ValueError(f"max_gaussians is {most}, but the scene starts with {len(scene.points)} points")
        scene = with_rounded_poses(scene)
        inspector = inspector or Inspector()
        unused = list[LeftOut]()
        if "photos" in asked.leave_out:
            scene, unused = choose_photos(scene)
        self.scene: Scene = scene
        self.given: Scene = scene if self._frame is None else self._frame.outward(scene)
        self.asked: TrainConfig = asked
        facts = facts_of(scene, unused)
        self.diagnosis: Diagnosis | None = inspector.diagnose(scene) if asks_for_diagnosis(asked) else None
        settings = plan_run(facts, self.diagnosis, asked).settings
        if begin is not None and self.diagnosis is not None and asked.leave_out:
            facts = replace(facts, looks=tried_looks(scene, settings, begin, inspector.on_stage))
            settings = plan_run(facts, self.diagnosis, asked).settings
        self.facts: Facts = facts
        self.form(settings, inspector)
        # Of more photos, where the method asks for it.
        self.shown_diagnosis: Diagnosis | None = inspector.last
        self._on_stage = inspector.on_stage
        self._points: dict[tuple[int, bool], tuple[Points, Colors, float]] = {}
        self._begin: Begin | None = begin
        self._has_tried: bool = False

    def form(self, settings: TrainConfig, inspector: Inspector) -> None:
        """Make the method of these settings, which has learned nothing, and what renders are compared to."""
        self.method: Method[Any] = MAKERS[settings.method](self.scene, settings, inspector)
        self.training_views: TrainingViews = TrainingViews(self.scene.train, self.method, settings.background)
        self.facts = self.method.facts(self.facts, self.training_views.targets)

    def plan(self, seconds: StepSeconds | None = None) -> RunPlan:
        """The plan of the run; `seconds`: what steps take on this machine, where they were timed.

        It is made anew with each fact that a plan asks for: whether photos agree on as many points as it
        wants, and whether growth pays.
        """
        facts = replace(self.facts, seconds=seconds)
        plan = plan_run(facts, self.diagnosis, self.asked)
        if plan.first_points > facts.points and self.scene.seen is not None:
            facts = replace(facts, agreed=self._first_points(plan.first_points, plan.found_back)[2])
            plan = plan_run(facts, self.diagnosis, self.asked)
        timed = self.asked.seconds is None or seconds is not None  # the length of the run is known
        in_doubt = "growth" in self.asked.leave_out and timed and growth_in_doubt(facts, plan)
        if self._begin is not None and in_doubt and calls_for_trial(self.scene, plan):
            if not self._has_tried:  # once for a run
                self._has_tried = True
                tried = tried_growth(self.scene, plan, self._begin, self._on_stage)
                self.facts = replace(self.facts, tried=tried)
            facts = replace(facts, tried=self.facts.tried)
            plan = plan_run(facts, self.diagnosis, self.asked)
        return plan

    def first_gaussians(self, plan: RunPlan) -> Gaussians:
        """Those that a run of this plan trains."""
        settings = plan.settings
        with one_torch_thread():
            points, colors, _ = self._first_points(plan.first_points, plan.found_back)
            gaussians = Gaussians.from_points(points, colors, settings.sh_degree)
            if plan.discs and len(points) > len(self.scene.points):
                gaussians = as_discs(gaussians)
            return self.method.start(gaussians, settings.iterations)

    def outward(self, trained: Gaussians) -> Gaussians:
        """Gaussians of `scene` in the frame of `given`."""
        return trained if self._frame is None else self._frame.gaussians(trained)

    def _first_points(self, wanted: int, found_back: bool) -> tuple[Points, Colors, float]:
        """The scene's points and more that other photos agree with, at most `wanted` in all; and the share of
        the pixels asked at which they do."""
        scene, (points, colors) = self.scene, (self.scene.points, self.scene.point_colors)
        if scene.seen is None or wanted <= len(points):
            return points, colors, 1.0
        if (key := (wanted, found_back)) not in self._points:
            agreement = Agreement(scene.train, scene.seen)
            given = points, scene.seen, wanted - len(points), self.asked.seed, agreement, self._on_stage
            more, their_colors, agreed = points_along_edges(scene.train, *given, found_back)
            both = np.concatenate([points, more]), np.concatenate([colors, their_colors])
            self._points[key] = *both, agreed
        return self._points[key]


def plan_of_photos(scene: Scene, asked: TrainConfig) -> tuple[RunPlan, list[str]]:
    """The plan of photos that have no poses yet, as far as it goes; and what is not decided before that."""
    diagnosis = Inspector().diagnose(scene) if asks_for_diagnosis(asked) else None
    later = [rule.what for rule in RULES[1:] if rule not in OF_PHOTOS_ALONE]
    return plan_run(facts_of(scene), diagnosis, asked, OF_PHOTOS_ALONE), later


def facts_of(scene: Scene, unused: list[LeftOut] | None = None) -> Facts:
    """What a scene tells before a method has looked at its photos; `unused`: photos it does without."""
    cameras = [view.camera for view in scene.train]
    photos = scene.of or len(cameras)
    return Facts(
        photos=photos,
        pixels=sum(camera.width * camera.height for camera in cameras) * photos // len(cameras),
        shortest_side=min(min(camera.width, camera.height) for camera in cameras),
        points=len(scene.points),
        linked=scene.seen is not None,
        found=scene.sfm is not None,
        unused=tuple(unused or ()),
    )


def asks_for_diagnosis(asked: TrainConfig) -> bool:
    """Whether somebody must look at the photos before the run is planned."""
    formed = asked.method in (AUTO, "hqgs") and asked.hqgs.guidance == FORMATION
    return formed and asked.hqgs.formation == AUTO
