"""Localizers and policies; importing this package registers every localizer."""

from agents.factor_graph import pose_graph as _pose_graph  # noqa: F401
from agents.kalman import ekf as _ekf  # noqa: F401
from agents.kalman import ekf_joint as _ekf_joint  # noqa: F401
from agents.kalman import emvf as _emvf  # noqa: F401
from agents.localizer import LOCALIZERS, Estimate, Localizer, make, options_of, register
from agents.particle import hybrid as _hybrid  # noqa: F401
from agents.particle import pf as _pf  # noqa: F401
from agents.particle import pf_joint as _pf_joint  # noqa: F401
from agents.particle import pfnn as _pfnn  # noqa: F401
from agents.policies import learned as _learned_policy  # noqa: F401
from agents.stdcl import stdcl as _stdcl  # noqa: F401
from agents.stein import cspf as _cspf  # noqa: F401
from agents.stein import stein_vi as _stein_vi  # noqa: F401
from agents.swarm import dwmds as _costa_mds  # noqa: F401
from agents.swarm import dwmds_st as _dwmds  # noqa: F401
from agents.swarm import fcmds as _fc_mds  # noqa: F401
from agents.swarm import map as _team_map  # noqa: F401
from agents.swarm import mds as _mds  # noqa: F401
from agents.swarm import vmds as _velocity_mds  # noqa: F401
from agents.trust import trusting as _trusting  # noqa: F401

__all__ = ["LOCALIZERS", "Estimate", "Localizer", "make", "options_of", "register"]
