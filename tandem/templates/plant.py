"""A plant: a cart on a rail. Change everything; this file runs without changes.

    tandem model check THIS_FILE:PLANT
    tandem run --set plant.model=THIS_FILE:PLANT

Below is the same cart twice: PLANT has its equations, and MATRICES has matrices only. Keep the one that you need.
"""

import casadi as ca

from lbmpc.plants import Known, Plant

PARAMETERS = {"mass": 1.5, "friction": 0.6, "drag": 0.8}
"""kg, N s/m, N s^2/m^2. A true plant may have others: tandem run --set plant.truth.drag=1.2"""


def equations(mass, friction, drag):
    """dx/dt of a cart with these parameters, in CasADi's operations: ca.sin, not math.sin, and ca.if_else, not if."""

    def rhs(x, u):
        speed, force = x[1], u[0]
        # Drag has no slope at rest: the linear model does not contain it, and the network learns it.
        return [speed, (force - friction * speed - drag * speed * ca.fabs(speed)) / mass]

    return rhs


PLANT = Plant(
    name="cart",
    # Names are for plots, tables and messages; units for a person, "t" is time.
    states=["position", "speed"],
    inputs=["force"],
    units={"position": "m", "speed": "m/s", "force": "N", "t": "s"},
    rhs=equations(**PARAMETERS),
    equations=equations,
    parameters=PARAMETERS,
    # The desired equilibrium: dx/dt = 0 there.
    x_e=[0.0, 0.0],
    u_e=[0.0],
    # Bounds that the controller keeps; infinite without a bound. Then scale={"speed": 1.0} says what counts as 1.
    x_min=[-1.0, -1.0],
    x_max=[1.0, 1.0],
    u_min=[-3.0],
    u_max=[3.0],
    # Error of the linear model, per second, as half-widths of a box: `tandem model check` shows its size.
    W=[0.01, 0.1],
    # Initial state of a simulation.
    x0=[-0.8, 0.0],
    # The machine's input without commands. If it does not hold the plant, also set
    # safe_gain=[[..]]: then safe_input + safe_gain (x - x_e).
    safe_input=[0.0],
    # Seconds from writing an input until the plant begins to answer. Time in a network or a computer before
    # the input is written is measured, and not a part of this.
    dead_time=0.0,
    # States for reports, by index; and the inputs of the kernel of the oracle l2nw.
    performance=[0],
    kernel=["speed", "force"],
)

# Without equations: dx/dt = A x + B u in deviations from (x_e, u_e), or x+ = A x + B u with period=0.05.
# All other arguments have defaults. `tandem identify LOG` finds A, B and W from a log. In a simulation the plant moves
# by these matrices, or as another plant:
#     tandem run --set plant.model=THIS_FILE:MATRICES --set plant.truth=THIS_FILE:PLANT
MATRICES = Known.from_matrices(
    A=[[0.0, 1.0], [0.0, -0.4]],
    B=[[0.0], [0.667]],
    W=[0.01, 0.1],
    name="cart",
    states=["position", "speed"],
    inputs=["force"],
    x_min=[-1.0, -1.0],
    x_max=[1.0, 1.0],
    u_min=[-3.0],
    u_max=[3.0],
    x0=[-0.8, 0.0],
)
