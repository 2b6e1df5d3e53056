"""Reads the map of an ECOD cell, and reports detections to it.

    import ecod

    with ecod.Cell("localhost:1883", "lot-1") as cell:
        for map in cell.maps():
            print(map.round, map.objects)
"""

from . import geo
from .cell import BROKER_NAME, Cell
from .convert import boxes_from_coco, boxes_from_supervision, boxes_from_ultralytics, from_arrays, from_supervision
from .errors import EcodError, Invalid, Refused, Silent, Unreachable
from .messages import BoxReport, Camera, CellDescription, DescriptionStatus, FieldOfView, FusedObject
from .messages import GlobalMap, LabelReading, LandmarkState, Mount, NeighbourObject, NodeStatus, ObjectReport
from .messages import PerceivedObject, PixelBox, Pose, PoseCorrection, Reputation, Reputations, Trouble, Verdict
from .messages import Verdicts, time_of

# fmt: off
__all__ = [
    "BROKER_NAME", "BoxReport", "Camera", "Cell", "CellDescription", "DescriptionStatus", "EcodError", "FieldOfView",
    "FusedObject", "GlobalMap", "Invalid", "LabelReading", "LandmarkState", "Mount",
    "NeighbourObject", "NodeStatus", "ObjectReport", "PerceivedObject", "PixelBox", "Pose", "PoseCorrection",
    "Refused", "Reputation", "Reputations", "Silent", "Trouble", "Unreachable", "Verdict", "Verdicts",
    "boxes_from_coco", "boxes_from_supervision", "boxes_from_ultralytics", "from_arrays", "from_supervision", "geo",
    "time_of",
]
