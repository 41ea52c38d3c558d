"""Random small MuJoCo models that MJX steps.

Each has a tree of one to eight bodies, joints of all kinds with and without limits, geoms of which
few can touch, actuators, and sometimes constraints, tendons and sensors. All numbers are those of
robots of the size of a hand, so that a step of float32 means something.
"""

import random

import mujoco
import numpy as np

from helpers.small_models import c_steps

LARGEST_NV = 8
"""Degrees of freedom at which no more joints are added: XLA compiles larger models for minutes."""

AXES = ("1 0 0", "0 1 0", "0 0 1", "1 1 0", "0.3 -0.5 0.8")

SENSORS = (
    *("jointpos", "jointvel", "actuatorfrc", "framepos", "framequat", "framelinvel"),
    *("frameangvel", "velocimeter", "gyro", "accelerometer", "subtreecom", "clock"),
)


LARGEST_NUMBER = 100.0
"""Of positions [m, rad] and velocities [m/s, rad/s]."""


def random_model(seed, count):
    """Return a random model, the same for the same seed, and what `c_steps` returns for it.

    A model that explodes in C MuJoCo is drawn anew: of numbers without bounds no step means
    anything.

    Args:
      seed: the seed.
      count: number of instances.
    """
    for attempt in range(100):
        model = mujoco.MjModel.from_xml_string(random_mjcf(100 * seed + attempt))
        # C MuJoCo would begin anew where an acceleration is too large.
        flags = model.opt.disableflags
        model.opt.disableflags = flags | mujoco.mjtDisableBit.mjDSBL_AUTORESET
        before, after, ctrl = c_steps(model, count, most=10, seed=seed)
        model.opt.disableflags = flags
        numbers = [fields[name] for fields in (before, after) for name in ("qpos", "qvel")]
        if all(np.abs(x).max() < LARGEST_NUMBER for x in numbers):
            return model, before, after, ctrl
    raise AssertionError(f"no random model of seed {seed} is stable")


def random_mjcf(seed):
    """Return the MJCF of a random model, the same for the same seed."""
    return _Generator(seed).mjcf()


class _Generator:
    """Draws the parts of one model, and remembers their names for what refers to them."""

    def __init__(self, seed):
        self._random = random.Random(seed)
        self._nv = 0
        self._bodies, self._joints, self._sites = [], [], []
        self._free = []
        """Bodies that nothing holds."""
        self._contacts = self._random.choice([0, 0, 1, 2, 3])
        """How many geoms may still be given contacts."""
        # MJX knows no elliptic cone of a contact without friction, nor without contacts.
        self._is_elliptic, self._has_friction = self._chance(0.5), False

    def mjcf(self):
        floor = '<geom name="floor" type="plane" size="5 5 0.1" contype="1" conaffinity="0"/>'
        floor = floor if self._contacts else ""
        trees, left = [], self._random.choice([1, 1, 2, 2, 3, 4, 5, 6, 8])
        while left > 0:
            size = self._random.randint(1, left)
            trees.append(self._body(None, size))
            left -= size
        parts = [
            '<default><geom contype="0" conaffinity="0"/></default>',
            f"<worldbody>{floor}{''.join(trees)}</worldbody>",
            self._equalities(),
            self._tendons(),
            self._actuators(),
            self._sensors(),
        ]
        return f"<mujoco>{self._options()}{''.join(parts)}</mujoco>"

    # What draws.

    def _chance(self, probability):
        return self._random.random() < probability

    def _number(self, low, high):
        return round(self._random.uniform(low, high), 3)

    def _vector(self, low, high, count=3):
        return " ".join(str(self._number(low, high)) for _ in range(count))

    def _sometimes(self, probability, **attributes):
        """Attributes, each of them with a probability; a value is drawn only if it is needed."""
        drawn = {k: v() for k, v in attributes.items() if self._chance(probability)}
        return "".join(f' {name}="{value}"' for name, value in drawn.items())

    # Parts of a model.

    def _options(self):
        r = self._random
        flags = ("eulerdamp", "warmstart", "refsafe", "gravity", "filterparent", "limit")
        disabled = [name for name in flags if self._chance(0.08)]
        flag = "".join(f' {name}="disable"' for name in disabled)
        attributes = {
            "timestep": r.choice([0.002, 0.005, 0.01]),
            # Four times as large, a step by Runge and Kutta takes long to compile.
            "integrator": r.choice(
                ["Euler", "Euler", "Euler", "implicitfast", "implicitfast", "RK4"]
            ),
            "cone": "elliptic" if self._has_friction and self._is_elliptic else "pyramidal",
            "solver": r.choice(["Newton", "Newton", "CG"]),
            "iterations": r.choice([4, 20, 100]),
            "ls_iterations": r.choice([4, 10, 50]),
            "tolerance": r.choice(["1e-8", "1e-6"]),
        }
        text = "".join(f' {name}="{value}"' for name, value in attributes.items())
        text += self._sometimes(
            0.15, impratio=lambda: r.choice([1, 3, 10]), gravity=lambda: self._vector(-5, 5)
        )
        # MJX has no derivative of a fluid's drag.
        if attributes["integrator"] != "implicitfast":
            text += self._sometimes(
                0.15,
                density=lambda: self._number(1, 100),
                viscosity=lambda: self._number(0.001, 0.1),
                wind=lambda: self._vector(-1, 1),
            )
        return f"<option{text}><flag{flag}/></option>"

    def _body(self, parent, size):
        """A body and those below it, `size` in all."""
        name = f"b{len(self._bodies)}"
        self._bodies.append(name)
        where = self._vector(-0.3, 0.3, 2) + f" {self._number(0.05, 0.4)}"
        text = f'<body name="{name}" pos="{where}"'
        text += self._sometimes(0.3, euler=lambda: self._vector(-90, 90))
        text += self._sometimes(0.1, gravcomp=lambda: self._number(0, 1)) + ">"
        joints = self._own_joints(parent)
        self._free += [name] if 'type="free"' in joints else []
        text += joints + self._geom()
        if self._chance(0.5):
            self._sites.append(f"s{len(self._sites)}")
            text += f'<site name="{self._sites[-1]}" pos="{self._vector(-0.1, 0.1)}"/>'
        left = size - 1
        while left > 0:
            part = self._random.randint(1, left)
            text += self._body(name, part)
            left -= part
        return text + "</body>"

    def _own_joints(self, parent):
        if parent is None and self._nv + 6 <= LARGEST_NV and self._chance(0.3):
            self._nv += 6
            return self._joint("free")
        # A body of the world that does not move would have no use.
        fewest = 1 if self._nv == 0 else 0
        kinds = self._random.choices(
            ["hinge", "hinge", "hinge", "slide", "slide", "ball"],
            k=self._random.choice([fewest, 1, 1, 1, 2]),
        )
        text, axes = "", self._random.sample(AXES, len(kinds))
        # A ball turns about all axes: another rotation beside it makes the inertia singular.
        if "ball" in kinds:
            kinds = ["ball"] + ["slide"] * kinds.count("slide")
        for kind, axis in zip(kinds[::-1], axes, strict=False):
            size = 3 if kind == "ball" else 1
            if self._nv + size <= LARGEST_NV:
                self._nv += size
                text += self._joint(kind, axis)
        return text

    def _joint(self, kind, axis=None):
        name = f"j{len(self._joints)}"
        self._joints.append((name, kind))
        if kind == "free":
            return f'<joint name="{name}" type="free"/>'
        text = f'<joint name="{name}" type="{kind}"'
        if kind != "ball":
            text += f' axis="{axis}"'
        text += self._sometimes(0.2, pos=lambda: self._vector(-0.1, 0.1))
        if self._chance(0.4):
            low, high = {"hinge": (-60, 60), "slide": (-0.3, 0.3), "ball": (0, 80)}[kind]
            low, high = (low and self._number(low, 0)), self._number(high / 2, high)
            text += f' limited="true" range="{low} {high}"'
        return f"{text}{self._of_a_joint()}/>"

    def _of_a_joint(self):
        return self._sometimes(
            0.35,
            damping=lambda: self._number(0.01, 0.2),
            armature=lambda: self._number(0.01, 0.2),
            stiffness=lambda: self._number(0.1, 5),
        ) + self._sometimes(
            0.12,
            frictionloss=lambda: self._number(0.01, 0.3),
            springref=lambda: self._number(-0.5, 0.5),
            margin=lambda: self._number(0.001, 0.02),
            solimplimit=lambda: "0.8 0.95 0.01",
            solreflimit=lambda: "0.03 1.2",
        )

    def _geom(self):
        kind = self._random.choice(["sphere", "sphere", "capsule", "capsule", "box"])
        size = self._vector(0.03, 0.15, {"sphere": 1, "capsule": 2, "box": 3}[kind])
        text = f'<geom type="{kind}" size="{size}" mass="{self._number(0.1, 2)}"'
        text += self._sometimes(0.3, pos=lambda: self._vector(-0.1, 0.1))
        text += self._sometimes(0.3, euler=lambda: self._vector(-90, 90))
        if self._contacts and self._chance(0.7):
            self._contacts, self._has_friction = self._contacts - 1, True
            # The first meets the floor only, the second the first too: few pairs can touch.
            second = self._contacts == 0 and kind == "sphere" and self._chance(0.5)
            text += f' contype="{2 if second else 0}" conaffinity="{1 if second else 3}"'
            text += self._sometimes(
                0.3,
                condim=lambda: self._random.choice(
                    [3, 4, 6] if self._is_elliptic else [1, 3, 4, 6]
                ),
                friction=lambda: f"{self._number(0.2, 1.2)} 0.01 0.001",
                margin=lambda: self._number(0.001, 0.02),
                solref=lambda: "0.01 1.1",
                solimp=lambda: "0.85 0.97 0.005",
                priority=lambda: 1,
                solmix=lambda: 2,
            )
        return text + "/>"

    def _equalities(self):
        if not self._chance(0.2):
            return ""
        scalar = self._of_kind("hinge", "slide")
        anchor = self._vector(-0.05, 0.05)
        body, scale = self._random.choice(self._bodies), self._number(0.5, 2)
        choices = [f'<connect body1="{body}" anchor="{anchor}"/>']
        # A weld of what cannot move freely cannot be satisfied: MJX's solver ends in NaN there.
        choices += [f'<weld body1="{x}" torquescale="{scale}"/>' for x in self._free[:1]]
        if len(scalar) > 1:
            one, other = self._random.sample(scalar, 2)
            polycoef = f"{self._number(-0.1, 0.1)} {self._number(0.5, 2)} 0.1 0 0"
            choices += [f'<joint joint1="{one}" joint2="{other}" polycoef="{polycoef}"/>'] * 3
        return f"<equality>{self._random.choice(choices)}</equality>"

    def _tendons(self):
        scalar = self._of_kind("hinge", "slide")
        if len(scalar) < 2 or not self._chance(0.25):
            return ""
        parts = "".join(
            f'<joint joint="{name}" coef="{self._number(-1, 1)}"/>'
            for name in self._random.sample(scalar, 2)
        )
        text = self._sometimes(
            0.5,
            damping=lambda: self._number(0.01, 0.2),
            stiffness=lambda: self._number(0.1, 2),
            frictionloss=lambda: self._number(0.01, 0.1),
        )
        if self._chance(0.3):
            text += ' limited="true" range="-0.2 0.2"'
        return f'<tendon><fixed name="t0"{text}>{parts}</fixed></tendon>'

    def _actuators(self):
        scalar = self._of_kind("hinge", "slide")
        if not scalar:
            return ""
        count = self._random.choice([0, 1, 1, 2, 3])
        return f"<actuator>{''.join(self._actuator(scalar) for _ in range(count))}</actuator>"

    def _actuator(self, scalar):
        joint, own = self._random.choice(scalar), self._number(0.5, 5)
        kinds = {
            "motor": "",
            "position": f' kp="{own}"' + self._sometimes(0.5, kv=lambda: self._number(0.1, 1)),
            "velocity": f' kv="{own / 10:.3f}"',
            "general": f' gainprm="{own}"'
            + self._random.choice(
                [
                    ' dyntype="filter" dynprm="0.05"',
                    ' dyntype="filterexact" dynprm="0.03"',
                    ' dyntype="integrator" actlimited="true" actrange="-1 1"',
                    f' biastype="affine" biasprm="0.1 {-own} -0.2"',
                ]
            ),
        }
        kind = self._random.choice([*kinds])
        text = f'<{kind} joint="{joint}"{kinds[kind]}'
        text += self._sometimes(
            0.4,
            ctrlrange=lambda: f"{-self._number(0.2, 1)} {self._number(0.2, 1)}",
            forcerange=lambda: f"{-self._number(0.5, 5)} {self._number(0.5, 5)}",
            gear=lambda: self._number(0.2, 3),
        )
        return text + "/>"

    def _sensors(self):
        if not self._chance(0.3):
            return ""
        joints = self._of_kind("hinge", "slide")
        text = ""
        for kind in self._random.choices(SENSORS, k=self._random.randint(1, 4)):
            if kind == "clock":
                text += "<clock/>"
            elif kind == "subtreecom":
                text += f'<subtreecom body="{self._random.choice(self._bodies)}"/>'
            elif kind in ("jointpos", "jointvel") and joints:
                text += f'<{kind} joint="{self._random.choice(joints)}"/>'
            elif kind in ("velocimeter", "gyro", "accelerometer") and self._sites:
                text += f'<{kind} site="{self._random.choice(self._sites)}"/>'
            elif kind.startswith("frame"):
                body = self._random.choice(self._bodies)
                text += f'<{kind} objtype="body" objname="{body}"/>'
        return f"<sensor>{text}</sensor>"

    def _of_kind(self, *kinds):
        return [name for name, kind in self._joints if kind in kinds]
