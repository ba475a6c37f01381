"""Fisher information of each sensor about its UAVs' poses, at the truth.

Information matrices are over pose errors (δp in m, world; δθ in rad, right: R exp(δθ)), D = 6 in
space and 3 in the plane. ``truth`` is [B, N, …]; the masks of ``seen`` mark which measurements
arrived in just this world and step, and their values are never looked at. A modality is one
function here: ``own_information`` [B, N, D, D] for what one UAV measures of the world,
``motion_information`` [B, N, D + d, D + d] for what it measures of its velocity, too (δv in m/s,
world, after the pose), or ``shared_information`` [B, N, D, N, D] for what ties two UAVs together.

For z = h(x) + noise each contributes Hᵀ R⁻¹ H (Kay 1993, eq. 3.31), R the *true* noise.
"""

from dataclasses import replace
from functools import singledispatch

import torch
from jaxtyping import Float64
from torch import Tensor

from coloc_env.bounds.mixture import EXACT, distance_information, range_information
from coloc_env.geometry import cross_matrix, rotation_matrix
from coloc_env.geometry.walls import crossed, depth
from coloc_env.motion import Kinematics
from coloc_env.observation import Observation
from coloc_env.sensors import (
    AnchorRanging,
    ArrivalAngles,
    Height,
    LandmarkBearings,
    Landmarks,
    OpticalFlow,
    PositionFix,
    RangeNoise,
    Ranging,
    Sensor,
    Sight,
    Tdoa,
    UavBearings,
)
from coloc_env.sensors.angles import angles_by_vector
from coloc_env.sensors.ranging import Tags, tag_positions


@singledispatch
def own_information(
    sensor: Sensor, truth: Kinematics, seen: Observation
) -> Float64[Tensor, "B N D D"]:
    """Information of a sensor that measures the world, about each UAV's own pose."""
    raise NotImplementedError(f"bounds: no Fisher information is known for {type(sensor).__name__}")


@singledispatch
def motion_information(
    sensor: Sensor, truth: Kinematics, seen: Observation
) -> Float64[Tensor, "B N M M"]:
    """Information of a sensor that measures a UAV's velocity, about its pose and velocity."""
    raise NotImplementedError(f"bounds: no Fisher information is known for {type(sensor).__name__}")


def informs_of_motion(sensor: Sensor) -> bool:
    """Whether a sensor's information is about the velocity, too."""
    unknown = motion_information.dispatch(object)
    return motion_information.dispatch(type(sensor)) is not unknown


@singledispatch
def shared_information(
    sensor: Sensor, truth: Kinematics, seen: Observation
) -> Float64[Tensor, "B N D N D"]:
    """Information of a sensor between UAVs, about the team's joint pose."""
    raise NotImplementedError(f"bounds: no Fisher information is known for {type(sensor).__name__}")


# ---------------------------------------------------------------- what a UAV measures of the world


@own_information.register
def _landmarks(
    sensor: Landmarks, truth: Kinematics, seen: Observation
) -> Float64[Tensor, "B N D D"]:
    """z = Rᵀ(L − p) + N(0, σ² I).

    With a fraction ε of false matches, what is seen under a landmark's name is it with probability
    1 − ε and each other one with ε/(L−1). Which one it was counts as known: no estimator, not even
    one that re-associates, knows more, so the bound holds for all of them. (That of estimators that
    only discard false matches has (1 − ε) times the information.)
    """
    return gram(*landmark_rows(sensor, truth, seen))


def landmark_rows(
    sensor: Landmarks, truth: Kinematics, seen: Observation
) -> tuple[Float64[Tensor, "B N L d D"], Float64[Tensor, "B N L"]]:
    """Derivatives of each landmark's vector by the pose, and the information of its components."""
    visible = _mask(seen, "landmark_mask")
    others = sensor.false_matches / max(sensor.count - 1, 1)
    correct = 1 - others * (sensor.count - 1)
    expected = (correct - others) * visible + others * visible.sum(-1, keepdim=True)
    _, jacobian = _relative(truth, _points(seen, "landmark_map", truth))
    return jacobian, expected / max(sensor.std, EXACT) ** 2


@own_information.register
def _landmark_bearings(
    sensor: LandmarkBearings, truth: Kinematics, seen: Observation
) -> Float64[Tensor, "B N D D"]:
    """Range and bearing of Rᵀ(L − p), each with Gaussian noise."""
    count = _mask(seen, "landmark_bearing_mask").unflatten(-1, (sensor.depth, -1)).sum(-2)
    apart, jacobian = _relative(truth, _points(seen, "landmark_map", truth))
    polar = _polar_jacobian(apart, sensor.range_std, sensor.bearing_std) @ jacobian
    return gram(polar, count)


@own_information.register
def _anchor_ranging(
    sensor: AnchorRanging, truth: Kinematics, seen: Observation
) -> Float64[Tensor, "B N D D"]:
    """d = ‖p + R l_a − A_m‖ + noise, for own tag a and anchor m."""
    rows, weights = anchor_rows(sensor, truth, seen)
    return gram(rows.unsqueeze(-2), weights)


def anchor_rows(
    sensor: AnchorRanging, truth: Kinematics, seen: Observation
) -> tuple[Float64[Tensor, "B N M D"], Float64[Tensor, "B N M"]]:
    """Derivatives of each range by the pose, and its information, 0 where none arrived."""
    arrived = _mask(seen, "anchor_range_mask").unflatten(-1, (sensor.n_tags, -1))
    tags, jacobian = _tags(truth, sensor.tags)
    tags, anchors = tags.unsqueeze(-2), _points(seen, "anchor_map", truth).unsqueeze(2)
    rows = _unit(tags - anchors) @ jacobian  # [B, N, T, A, D]
    each = torch.full_like(arrived[0, 0, 0], range_information(sensor.noise))
    if sensor.sight.walls:
        each = each * _through(sensor.noise, sensor.sight, tags, anchors)
    if sensor.blocked:
        each[..., list(sensor.blocked)] = range_information(replace(sensor.noise, nlos=1.0))
    if sensor.noise.per_metre:
        each = distance_information(sensor.noise, (tags - anchors).norm(dim=-1))
    weights = arrived * each
    return rows.flatten(2, 3), weights.flatten(2)


@own_information.register
def _tdoa(sensor: Tdoa, truth: Kinematics, seen: Observation) -> Float64[Tensor, "B N D D"]:
    """z = ‖t − A_n‖ − ‖t − A_m‖ + e, t = p + R l: by t it changes as u_n − u_m. e: N(0, σ²), or a
    mixture of two."""
    shape = (sensor.depth, sensor.n_tags, -1)
    count = _mask(seen, "tdoa_mask").unflatten(-1, shape).sum(-3)  # [B, N, T, P]
    tags, jacobian = _tags(truth, sensor.tags)
    unit = _unit(tags.unsqueeze(-2) - _points(seen, "tdoa_map", truth).unsqueeze(2))
    m, n = sensor.ends
    rows = (unit[..., n, :] - unit[..., m, :]) @ jacobian
    std = max(sensor.std, EXACT)
    each = 1 / std**2
    if sensor.tail:
        each = range_information(RangeNoise(std, tail=sensor.tail, tail_std=sensor.tail_std))
    return gram(rows.flatten(2, 3).unsqueeze(-2), (count * each).flatten(2))


@own_information.register
def _position_fix(
    sensor: PositionFix, truth: Kinematics, seen: Observation
) -> Float64[Tensor, "B N D D"]:
    """z = p + N(0, diag σ²)."""
    dim = truth.position.shape[-1]
    pose = torch.eye(dim, 6 if dim == 3 else 3, dtype=torch.float64, device=truth.position.device)
    rows = pose.unsqueeze(1).expand(*truth.position.shape[:2], -1, -1, -1)
    variance = pose.new_tensor([max(std, EXACT) ** 2 for std in sensor.axis_std(dim)])
    return gram(rows, _mask(seen, "position_fix_mask") / variance)


@own_information.register
def _height(sensor: Height, truth: Kinematics, seen: Observation) -> Float64[Tensor, "B N D D"]:
    """z = p_z + N(0, σ²)."""
    row = truth.position.new_zeros(*truth.position.shape[:2], 1, 1, 6)
    row[..., 2] = 1.0
    return gram(row, _mask(seen, "height_mask") / max(sensor.std, EXACT) ** 2)


@motion_information.register
def _flow(sensor: OpticalFlow, truth: Kinematics, seen: Observation) -> Float64[Tensor, "B N 9 9"]:
    """z = (Rᵀ v)_xy + N(0, σ² I)."""
    rotation = rotation_matrix(truth.attitude)
    velocity = (truth.velocity.unsqueeze(-2) @ rotation).squeeze(-2)
    rows = velocity.new_zeros(*velocity.shape[:2], 1, 2, 9)
    rows[..., 0, :, 3:6] = _turn(velocity)[..., :2, :]
    rows[..., 0, :, 6:9] = rotation.mT[..., :2, :]
    return gram(rows, _mask(seen, "flow_mask") / max(sensor.std, EXACT) ** 2)


# ---------------------------------------------------------------- what ties two UAVs together


@shared_information.register
def _ranging(sensor: Ranging, truth: Kinematics, seen: Observation) -> Float64[Tensor, "B N D N D"]:
    """d = ‖p_i + R_i l_a − p_j − R_j l_b‖ + noise: one draw that both ends read, counted once.

    Over the tags' positions this is a Laplacian with u uᵀ for weights, u the unit vector along a
    link; the tags' Jacobians take it to the poses. Which links pass through walls, how much too
    long these make a range, and the clocks' errors count as known: no estimator knows more. Where
    obstacles are is not looked at: what passes through one counts as if it did not, which leaves
    the bound below what it could be.
    """
    t = sensor.n_tags
    links, along, jacobian = range_links(sensor, truth, seen)
    weights = (links.unsqueeze(-1) * along).unsqueeze(-1) * along.unsqueeze(-2)
    laplacian = -weights
    laplacian.diagonal(dim1=1, dim2=2).add_(weights.sum(2).movedim(1, -1))
    laplacian = laplacian.unflatten(2, (-1, t)).unflatten(1, (-1, t))
    return torch.einsum("bitxd,bitjsxy,bjsye->bidje", jacobian, laplacian, jacobian)


def range_links(
    sensor: Ranging, truth: Kinematics, seen: Observation
) -> tuple[Float64[Tensor, "B P P"], Float64[Tensor, "B P P d"], Float64[Tensor, "B N T d D"]]:
    """Information of the range between any two of the team's P tags, 0 where none arrived, its
    direction from the second to the first, and the tags' derivatives by the poses."""
    t = sensor.n_tags
    arrived = _mask(seen, "range_mask").unflatten(-1, (-1, t * t))
    links = _by_uav(arrived, seen).unflatten(-1, (t, t)).transpose(2, 3)  # [B, i, a, j, b]
    links = links.flatten(1, 2).flatten(2, 3)
    tags, jacobian = _tags(truth, sensor.tags)
    points = tags.flatten(1, 2)
    each = torch.full_like(links, range_information(sensor.noise))
    if sensor.walls:
        blocked = depth(points.unsqueeze(2), points.unsqueeze(1), sensor.walls) > 0
        each[blocked] = range_information(replace(sensor.noise, nlos=1.0))
    if sensor.sight.walls:
        each = each * _through(sensor.noise, sensor.sight, points.unsqueeze(2), points.unsqueeze(1))
    if sensor.noise.per_metre:
        apart = points.unsqueeze(2) - points.unsqueeze(1)
        each = distance_information(sensor.noise, apart.norm(dim=-1))
    links = torch.maximum(links, links.transpose(1, 2)) * each
    return links, _unit(points.unsqueeze(2) - points.unsqueeze(1)), jacobian


@shared_information.register
def _uav_bearings(
    sensor: UavBearings, truth: Kinematics, seen: Observation
) -> Float64[Tensor, "B N D N D"]:
    """Range and bearing of R_iᵀ(p_j − p_i), each end measuring for itself."""
    weights = seen_of_others(seen, "uav_bearing_mask", sensor.depth)
    apart, own = _relative(truth, truth.position.unsqueeze(1).expand(-1, len(weights[0]), -1, -1))
    return between(_polar_jacobian(apart, sensor.range_std, sensor.bearing_std) @ own, weights)


@shared_information.register
def _arrival_angles(
    sensor: ArrivalAngles, truth: Kinematics, seen: Observation
) -> Float64[Tensor, "B N D N D"]:
    """Azimuth and elevation of R_iᵀ(p_j − p_i), each end measuring for itself."""
    weights = seen_of_others(seen, "arrival_angle_mask", sensor.depth)
    apart, own = _relative(truth, truth.position.unsqueeze(1).expand(-1, len(weights[0]), -1, -1))
    std = own.new_tensor((sensor.azimuth_std, sensor.elevation_std)).clamp_min(EXACT)
    return between(angles_by_vector(apart) / std.unsqueeze(-1) @ own, weights)


def between(
    own: Float64[Tensor, "B N N k D"], weights: Float64[Tensor, "B N N"]
) -> Float64[Tensor, "B N D N D"]:
    """Information of what depends on p_j − p_i and the attitude of i, such as R_iᵀ(p_j − p_i), by
    its derivatives by i's pose."""
    d = 3 if own.shape[-1] == 6 else 2
    other = torch.zeros_like(own)
    other[..., :d] = -own[..., :d]  # only p_j − p_i matters, and the other's attitude not at all
    between = torch.einsum("bijxd,bij,bijxe->bidje", own, weights, other)
    joint = between + between.permute(0, 3, 4, 1, 2)
    ends = gram(own, weights) + gram(other.transpose(1, 2), weights.transpose(1, 2))
    joint.diagonal(dim1=1, dim2=3).add_(ends.movedim(1, -1))
    return joint


def seen_of_others(seen: Observation, mask: str, depth: int) -> Float64[Tensor, "B N N"]:
    """How often each UAV measured each other one."""
    arrived = _mask(seen, mask).unflatten(-1, (depth, -1)).sum(-2)
    return _by_uav(arrived.unsqueeze(-1), seen).squeeze(-1)


# ---------------------------------------------------------------- parts


def _mask(seen: Observation, name: str) -> Float64[Tensor, "B N F"]:
    return seen[name].double()


def _points(seen: Observation, name: str, truth: Kinematics) -> Float64[Tensor, "B N L d"]:
    return seen[name].double().unflatten(-1, (-1, truth.position.shape[-1]))


def _through(
    noise: RangeNoise,
    sight: Sight,
    start: Float64[Tensor, "B *#s d"],
    end: Float64[Tensor, "B *#s d"],
) -> Float64[Tensor, "B *s"]:
    """Share of a range's information that is left behind k walls, whose noise adds k s² to σ²; how
    many walls there are counts as known."""
    count = crossed(start, end, sight.walls)
    share, clear = torch.ones_like(count, dtype=torch.float64), range_information(noise)
    for k in range(1, int(count.max()) + 1):
        std = (noise.std**2 + k * sight.std**2) ** 0.5
        share[count == k] = range_information(replace(noise, std=std)) / clear
    return share


def _by_uav(slots: Float64[Tensor, "B N S k"], seen: Observation) -> Float64[Tensor, "B N N k"]:
    """From neighbour slots to UAV indices."""
    if "neighbours" not in seen:
        return slots
    n = slots.shape[1]
    index = seen["neighbours"].to(torch.int64).unsqueeze(-1).expand_as(slots)
    return slots.new_zeros(*slots.shape[:2], n, slots.shape[-1]).scatter_add(2, index, slots)


def gram(
    rows: Float64[Tensor, "B N M x D"], weights: Float64[Tensor, "B N M"]
) -> Float64[Tensor, "B N D D"]:
    """``Σ_m w_m H_mᵀ H_m``."""
    weighted = rows * weights[..., None, None]
    return rows.flatten(2, 3).mT @ weighted.flatten(2, 3)


def _unit(v: Float64[Tensor, "*s d"]) -> Float64[Tensor, "*s d"]:
    """The direction of v; 0 where it has none."""
    return v / v.norm(dim=-1, keepdim=True).clamp_min(EXACT)


def _turn(v: Float64[Tensor, "*s d"]) -> Float64[Tensor, "*s d t"]:
    """Derivative of ``exp(−δθ) v``, that is of ``Rᵀ x`` where v = Rᵀ x: [v]× or (v_y, −v_x)."""
    if v.shape[-1] == 3:
        return cross_matrix(v)
    return torch.stack((v[..., 1], -v[..., 0]), -1).unsqueeze(-1)


def _relative(
    truth: Kinematics, points: Float64[Tensor, "B N L d"]
) -> tuple[Float64[Tensor, "B N L d"], Float64[Tensor, "B N L d D"]]:
    """Body-frame vectors ``Rᵀ(x − p)`` to points and their Jacobians ``[−Rᵀ, [·]×]``."""
    rotation = rotation_matrix(truth.attitude)
    apart = (points - truth.position.unsqueeze(-2)) @ rotation
    back = -rotation.mT.unsqueeze(-3).expand(*apart.shape, -1)
    return apart, torch.cat((back, _turn(apart)), -1)


def _polar_jacobian(
    apart: Float64[Tensor, "*s 2"], range_std: float, bearing_std: float
) -> Float64[Tensor, "*s 2 2"]:
    """Derivatives of a vector's length and angle by the vector, in standard deviations."""
    along = _unit(apart)
    across = torch.stack((-along[..., 1], along[..., 0]), -1)
    distance = apart.norm(dim=-1, keepdim=True).clamp_min(EXACT)
    by_range = along / max(range_std, EXACT)
    return torch.stack((by_range, across / distance / max(bearing_std, EXACT)), -2)


def _tags(
    truth: Kinematics, tags: Tags
) -> tuple[Float64[Tensor, "B N T d"], Float64[Tensor, "B N T d D"]]:
    """World positions ``p + R l`` of each UAV's tags and their Jacobians ``[I, −R [l]×]``."""
    positions = tag_positions(truth, tags)
    arms = positions.new_tensor(tags) if tags else torch.zeros_like(positions[0])
    turned = -rotation_matrix(truth.attitude).unsqueeze(-3) @ _turn(arms)
    identity = torch.eye(positions.shape[-1], dtype=torch.float64, device=positions.device)
    return positions, torch.cat((identity.expand(*positions.shape, -1), turned), -1)
