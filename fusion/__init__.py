"""Where it is: fusing the robots' measurements of the same object.

from covis.fusion import fuse, fuse_own, register
"""

from .channel import Channel, ChannelOptions
from .gains import fuse, fuse_own
from .gaussian import Gaussian, covariance_intersection, fuse_gaussians, fuse_isotropic, fused_variance, fusion_gains
from .groups import Groups, group_detections
from .localmap import LocalMap, MapOptions
from .member import UNPROTECTED, Localized, Member, MemberOptions, Report
from .objects import FusedObjects, OwnObjects, agreement, own_objects, relative_pose
from .refine import Refined, refine
from .registration import RegistrationError, register
from .sequence import PairOptions, PairTracker
from .team import fuse_team
from .tracking import Batch, Tracker, TrackerOptions

__all__ = [
    "UNPROTECTED",
    "Batch",
    "Channel",
    "ChannelOptions",
    "FusedObjects",
    "Gaussian",
    "Groups",
    "LocalMap",
    "Localized",
    "MapOptions",
    "Member",
    "MemberOptions",
    "OwnObjects",
    "PairOptions",
    "PairTracker",
    "Refined",
    "RegistrationError",
    "Report",
    "Tracker",
    "TrackerOptions",
    "agreement",
    "covariance_intersection",
    "fuse",
    "fuse_gaussians",
    "fuse_isotropic",
    "fuse_own",
    "fuse_team",
    "fused_variance",
    "fusion_gains",
    "group_detections",
    "own_objects",
    "refine",
    "register",
    "relative_pose",
]
