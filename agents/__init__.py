"""Localizers and policies; importing this package registers every localizer."""

from agents import costa_mds as _costa_mds  # noqa: F401
from agents import cspf as _cspf  # noqa: F401
from agents import dwmds as _dwmds  # noqa: F401
from agents import ekf as _ekf  # noqa: F401
from agents import ekf_joint as _ekf_joint  # noqa: F401
from agents import emvf as _emvf  # noqa: F401
from agents import fc_mds as _fc_mds  # noqa: F401
from agents import hybrid as _hybrid  # noqa: F401
from agents import learned_policy as _learned_policy  # noqa: F401
from agents import mds as _mds  # noqa: F401
from agents import pf as _pf  # noqa: F401
from agents import pf_joint as _pf_joint  # noqa: F401
from agents import pfnn as _pfnn  # noqa: F401
from agents import pose_graph as _pose_graph  # noqa: F401
from agents import stdcl as _stdcl  # noqa: F401
from agents import stein_vi as _stein_vi  # noqa: F401
from agents import team_map as _team_map  # noqa: F401
from agents import trusting as _trusting  # noqa: F401
from agents import velocity_mds as _velocity_mds  # noqa: F401
from agents.localizer import LOCALIZERS, Estimate, Localizer, make, options_of, register

__all__ = ["LOCALIZERS", "Estimate", "Localizer", "make", "options_of", "register"]
