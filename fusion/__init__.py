"""Where it is: fusing the robots' measurements of the same object.

from covis.fusion import fuse, fuse_own, register
"""

from .gaussian import Gaussian, covariance_intersection, fuse_gaussians, fuse_isotropic, fused_variance, fusion_gains
from .objects import FusedObjects, Groups, OwnObjects, fuse, fuse_own, group_detections, own_objects, relative_pose
from .registration import RegistrationError, register

__all__ = [
    "FusedObjects",
    "Gaussian",
    "Groups",
    "OwnObjects",
    "RegistrationError",
    "covariance_intersection",
    "fuse",
    "fuse_gaussians",
    "fuse_isotropic",
    "fuse_own",
    "fused_variance",
    "fusion_gains",
    "group_detections",
    "own_objects",
    "register",
    "relative_pose",
]
