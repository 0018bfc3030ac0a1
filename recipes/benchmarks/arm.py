"""The one-joint arm of the benchmarks, a rod with a motor, in MJCF."""

__all__ = ["ARM"]

ARM = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <body name="link">
      <joint name="hinge" axis="0 1 0" damping="0.02"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.5" size=".02" mass=".5"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge"/></actuator>
</mujoco>
"""

TWO_LINKS = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0" damping="0.6" armature="0.02"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.35" size=".03" mass="1.2"/>
      <body name="fore" pos="0 0 -.35">
        <joint name="elbow" axis="0 1 0" damping="0.2" armature="0.008"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".025" mass=".7"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="shoulder motor" joint="shoulder" ctrlrange="-10 10"/>
    <motor name="elbow motor" joint="elbow" ctrlrange="-3 3"/>
  </actuator>
</mujoco>
"""
