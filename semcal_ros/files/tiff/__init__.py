"""SEM images as makers store them: TIFF with settings in private tags or a text file."""

from __future__ import annotations

from semcal_ros.files.tiff.read import is_tiff, read_sem_settings, read_sem_tiff
from semcal_ros.files.tiff.sem_image import SemImage

__all__ = ["SemImage", "is_tiff", "read_sem_settings", "read_sem_tiff"]
