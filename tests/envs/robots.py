"""Robots that nobody built, as users would describe them: models and descriptions, written into a directory."""

import yaml

PINCHER = """
<mujoco model="pincher">
  <compiler angle="radian"/>
  <option timestep="0.1" gravity="0 0 -1"/>
  <visual><map znear="0.1"/></visual>
  <worldbody>
    <light pos="0 0 3"/>
    <geom name="floor" type="plane" size="1 1 .1"/>
    <body name="base" pos="7 7 7">
      <geom type="cylinder" size=".05 .05" pos="0 0 .05"/>
      <body name="shoulder" pos="0 0 .12">
        <joint name="yaw" axis="0 0 1" range="-3 3"/>
        <geom type="sphere" size=".04" mass=".5"/>
        <body name="upper">
          <joint name="lift" axis="0 1 0" range="-1.5 2.5"/>
          <geom type="capsule" size=".03" fromto="0 0 0 0 0 .25" mass=".5"/>
          <body name="fore" pos="0 0 .25">
            <joint name="elbow" axis="0 1 0" range="-.5 2.8"/>
            <geom type="capsule" size=".025" fromto="0 0 0 0 0 .25" mass=".4"/>
            <body name="wrist" pos="0 0 .25">
              <joint name="bend" axis="0 1 0" range="-1 3"/>
              <geom type="capsule" size=".02" fromto="0 0 0 0 0 .04" mass=".2"/>
              <body name="palm" pos="0 0 .06">
                <joint name="roll" axis="0 0 1" range="-3 3"/>
                <geom name="fixed" type="box" size=".01 .005 .035" pos="0 -.03 .065" mass=".05"/>
                <geom name="drawn" type="sphere" size=".02" contype="0" conaffinity="0" mass="0"/>
                <site name="pinch" pos="0 .01 .09"/>
                <body name="jaw" pos="0 -.02 0">
                  <joint name="jaw" type="slide" axis="0 1 0" range="0 .07" armature=".3"/>
                  <geom name="moving" type="box" size=".01 .005 .035" pos="0 0 .065" mass=".05"/>
                </body>
              </body>
            </body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="yaw"/></actuator>
  <sensor><jointpos joint="yaw"/></sensor>
  <keyframe><key qpos="0 0 0 0 0 0"/></keyframe>
</mujoco>
"""
"""Five hinges and a jaw that closes against a fixed one, with all that a scene has of its own."""
PINCHER_DESCRIPTION = {
    "name": "pincher",
    "model": "pincher.xml",
    "base_position_m": [-0.36, 0.0, 0.0],
    "joints": ["yaw", "lift", "elbow", "bend", "roll"],
    "effector": {"frame": "pinch"},
    "fingers": [{"joint": "jaw", "closed": 0.0, "open": 0.07}],
    "opening_m": 0.07,
    "home": [0.0, 0.3, 1.5, 1.34, 0.0],
    "orientation": "down_any_turn",
    "armature": 0.3,
    "max_force": 40.0,
}
GANTRY = """
<mujoco model="gantry">
  <worldbody>
    <body name="bridge">
      <joint name="x" type="slide" axis="1 0 0" range="-.5 .5"/>
      <geom type="box" size=".05 .5 .02" mass="1"/>
      <body name="car">
        <joint name="y" type="slide" axis="0 1 0" range="-.5 .5"/>
        <geom type="box" size=".05 .05 .02" mass="1"/>
        <body name="mast">
          <joint name="z" type="slide" axis="0 0 1" range="-.5 .3"/>
          <geom type="capsule" size=".02" fromto="0 0 0 0 0 .4" mass="1"/>
          <site name="flange" quat="0 1 0 0"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
HAND = """
<mujoco model="hand">
  <worldbody>
    <body name="bridge">
      <geom type="box" size=".02 .06 .01" mass=".2"/>
      <site name="grip" pos="0 0 .1"/>
      <body name="one" pos="0 .04 0">
        <joint name="x" axis="1 0 0" range="-30 30" armature=".01"/>
        <geom type="capsule" size=".008" fromto="0 0 .02 0 0 .1" mass=".02"/>
      </body>
      <body name="two" pos="0 -.04 0">
        <joint name="z" axis="1 0 0" range="-30 30" armature=".01"/>
        <geom type="capsule" size=".008" fromto="0 0 .02 0 0 .1" mass=".02"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
"""Two fingers that turn, in degrees; it has names that the gantry has as well."""
GANTRY_DESCRIPTION = {
    "name": "gantry",
    "model": "gantry.xml",
    "hand": {"model": "hand.xml", "at": "flange"},
    "base_position_m": [0.0, 0.0, 0.3],
    "joints": ["x", "y", "z"],
    "effector": {"frame": "hand/grip"},
    "fingers": [
        {"joint": "hand/x", "closed": 0.4, "open": -0.4, "side": "left"},
        {"joint": "hand/z", "closed": -0.4, "open": 0.4, "side": "right"},
    ],
    "opening_m": 0.16,
    "home": [0.0, 0.0, 0.0],
    "orientation": "free",
    "armature": 1.0,
    "max_force": 200.0,
    "finger_stiffness": 20.0,
    "finger_damping": 1.0,
}


def _link(name, mass, inertia, shape="", origin="0 0 0"):
    spread = f'<inertia ixx="{inertia}" iyy="{inertia}" izz="{inertia}" ixy="0" ixz="0" iyz="0"/>'
    inertial = f'<inertial><origin xyz="{origin}"/><mass value="{mass}"/>{spread}</inertial>'
    collision = f'<collision><origin xyz="{origin}"/><geometry>{shape}</geometry></collision>' if shape else ""
    return f'<link name="{name}">{inertial}{collision}</link>'


def _joint(name, kind, parent, child, origin, axis, limit):
    ends = f'<parent link="{parent}"/><child link="{child}"/><origin xyz="{origin}"/><axis xyz="{axis}"/>'
    return f'<joint name="{name}" type="{kind}">{ends}<limit effort="100" velocity="3" {limit}/></joint>'


def _turn(limit):
    return f'lower="-{limit}" upper="{limit}"'


URDF = f"""
<robot name="sixer">
  <link name="base">
    <visual><geometry><cylinder radius="0.06" length="0.1"/></geometry></visual>
    <collision><origin xyz="0 0 0.05"/><geometry><cylinder radius="0.06" length="0.1"/></geometry></collision>
  </link>
  {_joint("yaw", "revolute", "base", "shoulder", "0 0 0.15", "0 0 1", _turn(3.1))}
  {_link("shoulder", 3, 0.01, '<sphere radius="0.06"/>')}
  {_joint("lift", "revolute", "shoulder", "upper", "0 0.1 0", "0 1 0", _turn(2.5))}
  {_link("upper", 4, 0.05, '<box size="0.08 0.08 0.4"/>', "0 0 0.2")}
  {_joint("elbow", "revolute", "upper", "fore", "0 -0.1 0.4", "0 1 0", _turn(2.8))}
  {_link("fore", 2, 0.03, '<box size="0.07 0.07 0.36"/>', "0 0 0.18")}
  {_joint("bend", "revolute", "fore", "wrist", "0 0 0.36", "0 1 0", _turn(2.8))}
  {_link("wrist", 1, 0.002)}
  {_joint("roll", "continuous", "wrist", "wrist2", "0 0.08 0", "0 0 1", "")}
  {_link("wrist2", 1, 0.002)}
  {_joint("turn", "revolute", "wrist2", "flange", "0 0 0.09", "0 1 0", _turn(3.1))}
  {_link("flange", 0.5, 0.001)}
  <joint name="mount" type="fixed">
    <parent link="flange"/><child link="palm"/><origin xyz="0 0.06 0" rpy="-1.5707963267948966 0 0"/>
  </joint>
  {_link("palm", 0.3, 0.001, '<box size="0.05 0.16 0.04"/>', "0 0 0.02")}
  <joint name="tip" type="fixed"><parent link="palm"/><child link="tool"/><origin xyz="0 0 0.12"/></joint>
  <link name="tool"/>
  {_joint("left", "prismatic", "palm", "left_finger", "0 0 0.04", "0 1 0", 'lower="0" upper="0.04"')}
  {_link("left_finger", 0.05, 1e-4, '<box size="0.02 0.016 0.08"/>', "0 0.008 0.05")}
  {_joint("right", "prismatic", "palm", "right_finger", "0 0 0.04", "0 -1 0", 'lower="0" upper="0.04"')}
  {_link("right_finger", 0.05, 1e-4, '<box size="0.02 0.016 0.08"/>', "0 -0.008 0.05")}
</robot>
"""
"""Six joints with shifted axes, one of them without limits, as URDF has them; the hand hangs on fixed joints."""
URDF_DESCRIPTION = {
    "name": "sixer",
    "model": "sixer.urdf",
    "base_position_m": [-0.6, 0.0, 0.0],
    "joints": ["yaw", "lift", "elbow", "bend", "roll", "turn"],
    "effector": {"frame": "tool"},
    "fingers": [
        {"joint": "left", "closed": 0.0, "open": 0.04, "side": "left"},
        {"joint": "right", "closed": 0.0, "open": 0.04, "side": "right"},
    ],
    "opening_m": 0.08,
    "home": [0.0, 0.33, 1.66, -0.42, -1.57, -1.57],
    "armature": 0.3,
}


def write_robot(directory, xml=PINCHER, description=PINCHER_DESCRIPTION, **changed):
    """A description's path; its model is beside it."""
    tree = {**description, **changed}
    (directory / description["model"]).write_text(xml)
    (directory / "hand.xml").write_text(HAND)
    path = directory / f"{description['name']}.yaml"
    path.write_text(yaml.safe_dump({key: value for key, value in tree.items() if value is not None}))
    return path
