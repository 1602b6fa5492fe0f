"""A transform as the lines that ROS and URDF take."""

from __future__ import annotations

from scipy.spatial.transform import Rotation

from optshape_graph._arrays import Floats
from optshape_graph.names import shell_word


def static_transforms(parent: str, child: str, T_parent_child: Floats) -> dict[str, str]:
    """Return the command lines of ROS 1 and ROS 2 that publish a transform, and the URDF origin of a fixed joint.

    Args:
        parent: name of the parent frame; what a shell would take for more than a word is quoted.
        child: name of the child frame.
        T_parent_child: (4, 4) pose of the child in the parent.
    """
    x, y, z = (f"{value:.9g}" for value in T_parent_child[:3, 3])
    parent, child = shell_word(parent), shell_word(child)
    rotation = Rotation.from_matrix(T_parent_child[:3, :3])
    qx, qy, qz, qw = (f"{value:.9g}" for value in rotation.as_quat(canonical=True))
    roll, pitch, yaw = (f"{value:.9g}" for value in rotation.as_euler("xyz"))
    return {
        "ros1": f"rosrun tf2_ros static_transform_publisher {x} {y} {z} {qx} {qy} {qz} {qw} {parent} {child}",
        "ros2": (
            f"ros2 run tf2_ros static_transform_publisher --x {x} --y {y} --z {z} "
            f"--qx {qx} --qy {qy} --qz {qz} --qw {qw} --frame-id {parent} --child-frame-id {child}"
        ),
        "urdf": f'<origin xyz="{x} {y} {z}" rpy="{roll} {pitch} {yaw}"/>',
    }
