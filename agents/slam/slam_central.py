"""One filter over a whole team and its map: the reference for UAVs that exchange maps."""

from agents.robust import SoftName
from agents.slam.slam import Slam
from coloc_env.options import PositiveCount
from coloc_env.scenario import Believed


class CentralSlam(Slam):
    """EKF-SLAM of the team's joint state and one map, with all ranges, whatever the network.
    ``iterations`` and ``robust`` as ``slam`` has them.

    Its belief holds each UAV's rows of the joint covariance, and the map's.
    """

    name = "slam_central"
    centralized = True

    def __init__(
        self,
        believed: Believed,
        *,
        iterations: PositiveCount = 3,
        robust: SoftName = "none",
    ) -> None:
        super().__init__(believed, iterations=iterations, robust=robust)
