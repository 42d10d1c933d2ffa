"""Blind diagnosis of photo degradations: which of them a scene's photos show, and how strong they are."""

from hqgs.diagnosis.photo import PhotoDiagnosis
from hqgs.diagnosis.scene import Diagnosis, Finding, diagnose_scene

__all__ = ["Diagnosis", "Finding", "PhotoDiagnosis", "diagnose_scene"]
