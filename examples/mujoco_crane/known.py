"""What the controller knows of the crane: a pair of matrices, from a point mass on a cable, about the load at rest.

    trolley s'' = force - drag s' + load g sway
    cable sway'' = -s'' - g sway

| parameter | known here | true, in `crane.xml` |
| --- | --- | --- |
| trolley, kg | 4 | the same |
| drag of the rail, N s/m | 4 | the same |
| load, kg | 2 | 3 |
| cable, m | 0.8 | 0.9 |
| wind, m/s | none | 8, from the left |
"""

from __future__ import annotations

from lbmpc.plants import Known

GRAVITY, TROLLEY, DRAG, LOAD, CABLE = 9.81, 4.0, 4.0, 2.0, 0.8

A = [
    [0, 0, 1, 0],
    [0, 0, 0, 1],
    [0, LOAD * GRAVITY / TROLLEY, -DRAG / TROLLEY, 0],
    [0, -(1 + LOAD / TROLLEY) * GRAVITY / CABLE, DRAG / (TROLLEY * CABLE), 0],
]
B = [[0], [0], [1 / TROLLEY], [-1 / (TROLLEY * CABLE)]]

CRANE = Known.from_matrices(
    A,
    B,
    name="crane",
    states=["position", "sway", "speed", "sway_rate"],
    inputs=["force"],
    units={"position": "m", "sway": "rad", "speed": "m/s", "sway_rate": "rad/s", "force": "N"},
    x_min=[-2.0, -0.4, -2.0, -2.0],
    x_max=[2.0, 0.4, 2.0, 2.0],
    u_min=[-20.0],
    u_max=[20.0],
    # What `tandem model check` finds of h, with MuJoCo as the truth, and a little more.
    W=[0.03, 0.05, 2.5, 4.5],
    x0=[-1.5, 0.0, 0.0, 0.0],
    # Without a force the wind would move it away.
    safe_gain=[[-10.0, 0.0, -15.0, 0.0]],
    performance=[0, 1],
)
