"""Placement of rovers at rest on the ground, as :func:`rover_rl.sims.free_space.rest_on_ground` does it."""

from __future__ import annotations

from rover_rl.native.warp import wp
from rover_rl.sims.free_space.ground import CLEARANCE, RIM_ANGLE, RIM_POINTS
from rover_rl.sims.scenes.scene import Scene, ground_at
from rover_rl.sims.warp.kernels.dynamics import clear_reports, write_base_state
from rover_rl.sims.warp.kernels.types import RobotModel, RoverArrays


@wp.func
def fitted_plane(scene: Scene, model: RobotModel, at: wp.vec2, ahead: wp.vec2) -> wp.vec3:
    """Plane fitted to the ground below the wheels: height at ``at`` (m), and slopes forward and to the left.

    Least squares over the hubs (x, y) in the base frame, whose x and y are uncorrelated: the slopes are separate
    regressions on the offsets from their middle m, ``s_x = sum(h (x - m_x)) / sum((x - m_x)^2)``.
    """
    middle = wp.vec2()
    for wheel in range(model.wheels):
        middle += wp.vec2(model.hubs[wheel][0], model.hubs[wheel][1]) / float(model.wheels)
    mean = float(0.0)
    covariance = wp.vec2()
    spread = wp.vec2()
    for wheel in range(model.wheels):
        hub = model.hubs[wheel]
        arm = wp.vec2(hub[0], hub[1]) - middle
        height = ground_at(
            scene, at[0] + hub[0] * ahead[0] - hub[1] * ahead[1], at[1] + hub[0] * ahead[1] + hub[1] * ahead[0]
        )[3]
        mean += height / float(model.wheels)
        covariance += height * arm
        spread += wp.cw_mul(arm, arm)
    slope = wp.cw_div(covariance, spread)
    return wp.vec3(mean - wp.dot(slope, middle), slope[0], slope[1])


@wp.func
def lowest_gap(scene: Scene, model: RobotModel, base: wp.vec3, rotation: wp.mat33) -> float:
    """Least height (m) of points on the lower half of the wheels' rims above the ground."""
    gap = float(wp.inf)
    for wheel in range(model.wheels):
        for k in range(RIM_POINTS):
            angle = RIM_ANGLE * (2.0 * float(k) / float(RIM_POINTS - 1) - 1.0)
            for side in range(-1, 2):
                rim = wp.vec3(
                    model.wheel_radius * wp.sin(angle),
                    float(side) * model.wheel_half_width,
                    -model.wheel_radius * wp.cos(angle),
                )
                point = base + rotation * (model.hubs[wheel] + rim)
                gap = wp.min(gap, point[2] - ground_at(scene, point[0], point[1])[3])
    return gap


@wp.func
def pose_at_rest(scene: Scene, model: RobotModel, pose: wp.vec3) -> wp.transform:
    """Pose of the base frame of a rover at rest on the ground, for a planar pose: x, y (m) and yaw (rad)."""
    at = wp.vec2(pose[0], pose[1])
    ahead = wp.vec2(wp.cos(pose[2]), wp.sin(pose[2]))
    plane = fitted_plane(scene, model, at, ahead)
    east = -plane[1] * ahead[0] + plane[2] * ahead[1]
    north = -plane[1] * ahead[1] - plane[2] * ahead[0]
    up = wp.normalize(wp.vec3(east, north, 1.0))
    forward = wp.vec3(ahead[0], ahead[1], plane[1])
    forward = wp.normalize(forward - wp.dot(forward, up) * up)
    rotation = wp.matrix_from_cols(forward, wp.cross(up, forward), up)
    base = wp.vec3(at[0], at[1], plane[0])
    base[2] += CLEARANCE - lowest_gap(scene, model, base, rotation)
    orientation = wp.quat_from_matrix(rotation)
    if orientation[3] < 0.0:
        orientation = -orientation
    return wp.transform(base, orientation)


@wp.kernel
def place(scenes: wp.array[Scene], models: wp.array[RobotModel], rovers: RoverArrays, poses: wp.array[wp.vec3]):
    """Places the active rovers at planar poses, x, y (m) and yaw (rad), at rest and with no stored impulses."""
    row = wp.tid()
    if rovers.active[row]:
        model = models[rovers.robot[row]]
        set_at_rest(model, rovers, row, pose_at_rest(scenes[rovers.scene[row]], model, poses[row]))


@wp.func
def set_at_rest(model: RobotModel, rovers: RoverArrays, row: int, pose: wp.transform):
    """Writes the state of a rover at rest, with its base frame at a pose."""
    orientation = wp.transform_get_rotation(pose)
    rovers.position[row] = wp.transform_get_translation(pose) + wp.quat_rotate(orientation, rovers.center[row])
    rovers.orientation[row] = orientation
    rovers.velocity[row] = wp.vec3(0.0, 0.0, 0.0)
    rovers.angular_velocity[row] = wp.vec3(0.0, 0.0, 0.0)
    for n in range(rovers.wheel_spins.shape[1]):
        rovers.wheel_spins[row, n] = 0.0
    for n in range(rovers.impulses.shape[1]):
        rovers.impulses[row, n] = 0.0
    for joint in range(rovers.angles.shape[1]):
        rovers.angles[row, joint] = 0.0
    rovers.contact[row] = False
    rovers.mover_contact[row] = False
    clear_reports(rovers, row)
    write_base_state(model, rovers, row)
