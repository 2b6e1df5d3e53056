"""Reads the map of an ECOD cell, and reports detections to it.

    import ecod

    with ecod.Cell("localhost:1883", "lot-1") as cell:
        for map in cell.maps():
            print(map.round, map.objects)
"""

from . import geo
from .cell import BROKER_NAME, Cell
from .convert import from_arrays, from_supervision
from .errors import EcodError, Invalid, Refused, Silent, Unreachable
from .messages import CellDescription, DescriptionStatus, FieldOfView, ForeignVotes, FusedObject, GlobalMap, LabelReading, LandmarkState
from .messages import NeighbourObject, NodeStatus, ObjectReport, PerceivedObject, Pose, PoseCorrection, Reputation, Reputations, Trouble, Verdict, Verdicts
from .messages import time_of

# fmt: off
__all__ = [
    "BROKER_NAME", "Cell", "CellDescription", "DescriptionStatus", "EcodError", "FieldOfView", "ForeignVotes", "FusedObject", "GlobalMap", "Invalid",
    "LabelReading", "LandmarkState", "NeighbourObject", "NodeStatus", "ObjectReport", "PerceivedObject", "Pose", "PoseCorrection", "Refused", "Reputation", "Reputations", "Silent",
    "Trouble", "Unreachable", "Verdict", "Verdicts", "from_arrays", "from_supervision", "geo", "time_of",
]
