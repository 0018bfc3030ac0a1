"""A link that a rotor drives through a spring or a gap: as two bodies, or with an armature."""

import mujoco
import numpy as np

ROTOR, LINK = 0.01, 0.02 + 0.5 * 0.1**2  # kg m²
_DRIVE = """
<mujoco><option timestep="{dt}" integrator="implicitfast"/><worldbody>
  <body><joint name="joint" axis="0 1 0" damping="0.1" armature="{armature}"/>
    <inertial pos="0 0 -.1" mass="0.5" diaginertia=".02 .02 .02"/></body>
  {rotor}
</worldbody>{tendon}
<actuator><motor name="motor" joint="{driven}" gear="2" ctrlrange="-2 2"/></actuator></mujoco>
"""
_BEHIND = f"""<body><joint name="rotor" axis="0 1 0"/>
  <inertial pos="0 0 0" mass="1" diaginertia="{ROTOR} {ROTOR} {ROTOR}"/></body>"""
_SHAFT = """<tendon><fixed name="shaft" {0}>
  <joint joint="rotor" coef="1"/><joint joint="joint" coef="-1"/></fixed></tendon>"""


def spring(hertz, damping):
    """Return a shaft that resonates, and its compliance."""
    reduced = ROTOR * LINK / (ROTOR + LINK)
    k = reduced * (2 * np.pi * hertz) ** 2
    return f'stiffness="{k}" damping="{2 * damping * np.sqrt(k * reduced)}" springlength="0"', 1 / k


def gap(width):
    """Return a shaft with play, and how much."""
    stiff = 'solreflimit="0.002 1" solimplimit="0.99 0.999 0.001"'
    return f'limited="true" range="{-width / 2} {width / 2}" {stiff}', width


def two_bodies(shaft, dt):
    """Return the model of rotor and link with a shaft between."""
    tendon = _SHAFT.format(shaft)
    xml = _DRIVE.format(dt=dt, armature=0, rotor=_BEHIND, driven="rotor", tendon=tendon)
    return mujoco.MjModel.from_xml_string(xml)


def one_body(dt, armature=ROTOR):
    """Return the model of the link alone, the rotor as its armature."""
    xml = _DRIVE.format(dt=dt, armature=armature, rotor="", tendon="", driven="joint")
    return mujoco.MjModel.from_xml_string(xml)
