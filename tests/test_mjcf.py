"""Loading, checking and editing MJCF arms."""

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError

from lwa4d_sim.arm import ARMS, GRAVITY
from lwa4d_sim.edits import ArmEdits, Friction, Payload
from lwa4d_sim.errors import ModelError
from lwa4d_sim.interfaces import Array
from lwa4d_sim.mjcf import chain_of, home, load_model, model_path, torque_limits

# A foreign arm with everything the shipped ones lack: masses from geoms, a frame, fixed bodies between and behind the
# links, an anchor off the origin, a slide, a tilted inertial frame, a joint reference, no limits, contacts.
FOREIGN = """
<mujoco model="foreign">
  <compiler angle="radian" inertiafromgeom="auto"/>
  <worldbody>
    <body name="table" pos="0.1 0.2 0.3" euler="0 0 0.4">
      <body name="arm1" pos="0 0 0.2" euler="0.3 0 0">
        <joint name="turn" axis="0 0.6 0.8" pos="0.01 -0.02 0.03" ref="0.25"/>
        <geom type="capsule" size="0.04" fromto="0 0 0 0 0 0.3"/>
        <body name="spacer" pos="0 0 0.3" euler="0 0.5 0.1">
          <geom type="sphere" size="0.05"/>
          <frame pos="0 0.01 0">
            <body name="arm2" pos="0.1 0 0">
              <inertial pos="0.02 0 0.1" euler="0.4 0.1 0" mass="2" diaginertia="0.02 0.015 0.01"/>
              <joint name="push" type="slide" axis="1 0 0" range="-0.2 0.3" limited="true"/>
              <body name="arm3" pos="0 0 0.2" euler="0 0 1">
                <joint name="bend" axis="0 1 0" actuatorfrcrange="-5 5"/>
                <geom type="box" size="0.03 0.03 0.1" pos="0 0 0.1"/>
                <body name="hand" pos="0 0 0.2" euler="0.2 0 0">
                  <geom type="sphere" size="0.03"/>
                  <site name="attachment_site" pos="0 0 0.03" euler="0 0.3 0"/>
                </body>
              </body>
            </body>
          </frame>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="m_turn" joint="turn"/>
    <motor name="m_push" joint="push" ctrlrange="-100 100" ctrllimited="true"/>
    <motor name="m_bend" joint="bend" ctrlrange="-20 20" ctrllimited="true"/>
  </actuator>
</mujoco>
"""
PAYLOAD = Payload(mass=1.5, com=(0.03, -0.02, 0.1), inertia=(0.01, 0.02, 0.015))


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """MuJoCo logs the divergence some tests ask for in the working directory; no shipped arm needs that directory."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def foreign(tmp_path: Path) -> str:
    path = tmp_path / "foreign.xml"
    path.write_text(FOREIGN)
    return str(path)


def terms(model: mujoco.MjModel, seed: int = 0) -> Array:
    """M, gravity and Coriolis torque at ten random states, in one array."""
    data = mujoco.MjData(model)
    rng = np.random.default_rng(seed)
    rows = []
    for _ in range(10):
        data.qpos[:], data.qvel[:] = rng.uniform(-1, 1, (2, model.nv))
        mujoco.mj_forward(model, data)
        M = np.empty((model.nv, model.nv))
        mujoco.mj_fullM(model, data, M)
        rows.append([*M, data.qfrc_bias])
    return np.array(rows)


@pytest.mark.parametrize("name", ARMS)
def test_shipped_arm_loads_as_it_is(name: str) -> None:
    model = load_model(name)
    plain = mujoco.MjModel.from_xml_path(str(model_path(name)))
    np.testing.assert_array_equal(terms(model), terms(plain))
    np.testing.assert_array_equal(home(model), ARMS[name].home)
    np.testing.assert_array_equal(torque_limits(model), ARMS[name].torque_max)
    assert model.opt.disableflags == plain.opt.disableflags | mujoco.mjtDisableBit.mjDSBL_AUTORESET


def test_diverged_simulation_is_not_made_calm() -> None:
    model = load_model("lwa4d_3dof", timestep=0.02, integrator="Euler")
    data = mujoco.MjData(model)
    data.qvel[:] = 1e12
    for _ in range(20):
        mujoco.mj_step(model, data)
    assert data.time == pytest.approx(0.4)  # a reset would have put the clock back
    assert not np.abs(data.qvel).max() < 1e6


def test_foreign_arm_keeps_its_own_ways(foreign: str, tmp_path: Path) -> None:
    model = load_model("foreign.xml", base=tmp_path)
    np.testing.assert_array_equal(torque_limits(model), [np.inf, 100, 5])
    np.testing.assert_array_equal(home(model), [0.25, 0, 0])  # the pose in which the file describes it
    assert not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT
    assert model.opt.timestep == 0.002


def test_timestep_and_integrator(foreign: str) -> None:
    model = load_model(foreign, timestep=0.0005, integrator="implicitfast")
    assert (model.opt.timestep, model.opt.integrator) == (0.0005, mujoco.mjtIntegrator.mjINT_IMPLICITFAST)


@pytest.mark.parametrize("tool", ["site", "body"])
def test_chain_reproduces_the_engine_s_kinematics(foreign: str, tool: str) -> None:
    """Multiply the chain out by hand at random joint positions and compare with MuJoCo."""
    if tool == "body":
        Path(foreign).write_text(FOREIGN.replace("attachment_site", "other_site"))
    model = load_model(foreign)
    chain = chain_of(model)
    assert chain.names == ("turn", "push", "bend")
    np.testing.assert_array_equal(chain.slide, [False, True, False])
    np.testing.assert_array_equal(chain.lower, [-np.inf, -0.2, -np.inf])
    np.testing.assert_array_equal(chain.upper, [np.inf, 0.3, np.inf])
    data = mujoco.MjData(model)
    rng = np.random.default_rng(5)
    for _ in range(20):
        data.qpos[:] = rng.uniform(-0.2, 0.2, 3) * [10, 1, 10]
        mujoco.mj_kinematics(model, data)
        x, R = np.zeros(3), np.eye(3)
        for i, angle in enumerate(data.qpos):
            x, R = x + R @ chain.pos[i], R @ chain.R[i]
            if chain.slide[i]:
                x = x + R @ chain.axis[i] * angle
                continue
            quat, turn = np.empty(4), np.empty(9)
            mujoco.mju_axisAngle2Quat(quat, chain.axis[i], angle)
            mujoco.mju_quat2Mat(turn, quat)
            x, R = x + R @ (chain.anchor[i] - turn.reshape(3, 3) @ chain.anchor[i]), R @ turn.reshape(3, 3)
        x, R = x + R @ chain.tool_pos, R @ chain.tool_R
        there = data.site("attachment_site") if tool == "site" else data.body("hand")
        np.testing.assert_allclose(x, there.xpos, atol=1e-14)
        np.testing.assert_allclose(R.ravel(), there.xmat, atol=1e-14)


# ---- edits, each against a second road


def test_payload_equals_a_body_added_by_hand(foreign: str) -> None:
    body = '<body {}><inertial pos="0.03 -0.02 0.1" mass="1.5" diaginertia="0.01 0.02 0.015"/></body>'
    edited = load_model(foreign, ArmEdits(payload=PAYLOAD))
    tool = '<site name="attachment_site"'
    Path(foreign).write_text(FOREIGN.replace(tool, body.format('pos="0 0 0.03" euler="0 0.3 0"') + tool))
    np.testing.assert_allclose(terms(edited), terms(load_model(foreign)), atol=1e-13)

    for name, arm in ARMS.items():
        text = model_path(name).read_text()
        at_flange = body.format(f'pos="0 0 {arm.tool[2]}"')
        by_hand = mujoco.MjModel.from_xml_string(text.replace('<site name="tcp"', at_flange + '<site name="tcp"'))
        edited = load_model(name, ArmEdits(payload=PAYLOAD))
        np.testing.assert_allclose(terms(edited), terms(by_hand), atol=1e-12)
        assert edited.nbody == by_hand.nbody - 1  # merged, so that a batch may mix payloads
        assert np.abs(terms(edited) - terms(load_model(name))).max() > 0.1


def test_default_payload_is_a_solid_sphere_at_the_flange() -> None:
    sphere = 0.4 * 2.0 * 0.1**2
    given = ArmEdits(payload=Payload(mass=2, inertia=(sphere, sphere, sphere)))
    default = ArmEdits(payload=Payload(mass=2, radius=0.1))
    np.testing.assert_allclose(terms(load_model("lwa4d_7dof", default)), terms(load_model("lwa4d_7dof", given)))
    nothing = load_model("lwa4d_7dof", ArmEdits(payload=Payload(mass=0)))
    np.testing.assert_allclose(terms(nothing), terms(load_model("lwa4d_7dof")), atol=1e-13)


@pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass'")
@pytest.mark.parametrize("scale", [2.0, (0.5, 3.0, 1.2)])
@pytest.mark.parametrize("attributes", ["", ' settotalmass="7"', ' inertiafromgeom="true"'])
def test_mass_scale_equals_scaling_the_compiled_model(foreign: str, scale: Any, attributes: str) -> None:
    Path(foreign).write_text(FOREIGN.replace(' inertiafromgeom="auto"', attributes))
    by_hand = load_model(foreign)
    for link, factor in zip(("arm1", "arm2", "arm3"), np.broadcast_to(scale, 3), strict=True):
        part = np.asarray(by_hand.body_weldid) == by_hand.body(link).id  # the spacer and the hand go with their links
        by_hand.body_mass[part] *= factor
        by_hand.body_inertia[part] *= factor
    mujoco.mj_setConst(by_hand, mujoco.MjData(by_hand))
    edited = load_model(foreign, ArmEdits(mass_scale=scale))
    np.testing.assert_allclose(terms(edited), terms(by_hand), atol=1e-13)
    np.testing.assert_allclose(edited.body_subtreemass, by_hand.body_subtreemass)
    np.testing.assert_allclose(edited.dof_invweight0, by_hand.dof_invweight0)


def test_mass_scale_leaves_the_payload_alone() -> None:
    both = terms(load_model("lwa4d_3dof", ArmEdits(payload=PAYLOAD, mass_scale=2)))
    bare, loaded = terms(load_model("lwa4d_3dof")), terms(load_model("lwa4d_3dof", ArmEdits(payload=PAYLOAD)))
    np.testing.assert_allclose(both - loaded, bare, atol=1e-12)


@pytest.mark.parametrize("armature", [0.3, (0.1, 0.2, 0.3), "lwa4d"])
def test_armature_adds_to_the_diagonal_of_M(armature: Any) -> None:
    edited = terms(load_model("lwa4d_3dof", ArmEdits(armature=armature)))
    rotor = ARMS["lwa4d_3dof"].armature if armature == "lwa4d" else np.broadcast_to(armature, 3)
    difference = edited - terms(load_model("lwa4d_3dof"))
    np.testing.assert_allclose(difference[:, :3], np.broadcast_to(np.diag(rotor), (10, 3, 3)), atol=1e-13)
    np.testing.assert_allclose(difference[:, 3], 0, atol=1e-13)


@pytest.mark.parametrize("friction", [Friction(viscous=(1.0, 2.0, 3.0), coulomb=4.0), "lwa4d"])
def test_friction_opposes_motion(friction: Any) -> None:
    model = load_model("lwa4d_3dof", ArmEdits(armature="lwa4d", friction=friction, gravity=(0, 0, 0)))
    arm = ARMS["lwa4d_3dof"]
    viscous, coulomb = (arm.viscous, arm.coulomb) if friction == "lwa4d" else (np.array([1, 2, 3]), np.full(3, 4.0))
    data = mujoco.MjData(model)
    data.qvel[:] = [0.5, -0.6, 0.7]
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.qfrc_passive, -viscous * data.qvel)
    np.testing.assert_allclose(data.qfrc_constraint, -coulomb * np.sign(data.qvel), rtol=1e-6)


def test_friction_replaces_the_model_s_own(foreign: str) -> None:
    Path(foreign).write_text(FOREIGN.replace('name="push"', 'name="push" damping="7 8 9" frictionloss="3"'))
    assert load_model(foreign).dof_damping[1] == 7
    model = load_model(foreign, ArmEdits(friction=Friction(viscous=0.5)))
    np.testing.assert_array_equal(model.dof_damping, 0.5)
    np.testing.assert_array_equal(model.dof_dampingpoly, 0)
    np.testing.assert_array_equal(model.dof_frictionloss, 0)


def test_gravity_scales_the_torque_at_rest() -> None:
    def at_rest(edits: ArmEdits) -> Array:
        model = load_model("lwa4d_7dof", edits)
        data = mujoco.MjData(model)
        data.qpos[:] = np.linspace(-1, 1, 7)
        mujoco.mj_forward(model, data)
        return np.array(data.qfrc_bias)

    moon = at_rest(ArmEdits(gravity=(0, 0, -1.62)))
    np.testing.assert_allclose(moon, at_rest(ArmEdits()) * 1.62 / GRAVITY, atol=1e-13)
    assert np.abs(moon).max() > 1


# ---- a step that damping allows


def test_stiff_friction_is_refused_with_the_largest_step() -> None:
    friction = ArmEdits(friction="lwa4d")
    with pytest.raises(
        ModelError, match=r"fastest pole is .* 1/s, so the timestep \(=0.001 s\) must be at most"
    ) as info:
        load_model("lwa4d_7dof", friction)
    largest = float(str(info.value).split("at most ")[1].split(" s;")[0])
    load_model("lwa4d_7dof", friction, timestep=0.99 * largest)
    with pytest.raises(ModelError, match="too stiff"):
        load_model("lwa4d_7dof", friction, timestep=1.01 * largest)
    for integrator in ("Euler", "implicit", "implicitfast", "discrete"):  # these treat damping implicitly
        load_model("lwa4d_7dof", friction, integrator=integrator)
    load_model("lwa4d_7dof", ArmEdits(friction="lwa4d", armature="lwa4d"))


@pytest.mark.parametrize(("integrator", "limit"), [("RK4", 2.785), ("Euler", 2.0)])
@pytest.mark.parametrize("factor", [0.98, 1.02])
def test_stability_limit_is_where_a_free_joint_diverges(
    foreign: str, integrator: str, limit: float, factor: float
) -> None:
    """One wheel, pole D/I = 1000 1/s: it slows down for steps below the limit and spins up above."""
    Path(foreign).write_text(
        """<mujoco><option gravity="0 0 0"><flag eulerdamp="disable" autoreset="disable"/></option><worldbody><body>
        <inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/><joint name="j" damping="10"/>
        </body></worldbody><actuator><motor joint="j"/></actuator></mujoco>"""
    )
    step = factor * limit / 1000
    model = mujoco.MjModel.from_xml_path(foreign)
    model.opt.timestep, model.opt.integrator = step, getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
    data = mujoco.MjData(model)
    data.qvel[0] = 1.0
    for _ in range(100):
        mujoco.mj_step(model, data)
    assert (abs(data.qvel[0]) < 1) == (factor < 1)
    if factor < 1:
        load_model(foreign, timestep=step, integrator=integrator)
    else:
        with pytest.raises(ModelError, match="at most"):
            load_model(foreign, timestep=step, integrator=integrator)


# ---- refusals


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("</body>", "<bod/>", "foreign.xml.*XML"),
        ('mass="2"', 'mass="-2"', "mass"),
        ('<joint name="turn" axis="0 0.6 0.8"', '<joint name="turn" type="ball"', "turn is neither hinge nor slide"),
        (
            '<joint name="bend"',
            '<joint name="more" axis="1 0 0"/><joint name="bend"',
            "arm3 has 2 joints; .* exactly one",
        ),
        (
            '<body name="hand"',
            '<body name="thumb"><joint name="t"/><geom size="1"/></body><body name="hand2"><joint name="u"/>'
            '<geom size="1"/></body><body name="hand"',
            "hand2 hangs on arm3 instead of thumb",
        ),
        (
            '<body name="table"',
            '<body name="box"><joint name="b"/><geom size="1"/></body><body name="table"',
            "arm1 hangs on world instead of box",
        ),
        ("<actuator>", '<equality><weld body1="hand"/></equality><actuator>', "equality constraint.*open chain"),
        ('<motor name="m_turn" joint="turn"/>', "", "turn has 0 motors; give every joint exactly one"),
        ('<motor name="m_push" joint="push"', '<motor name="m_push" joint="turn"', "turn has 2 motors"),
        (
            '<motor name="m_turn" joint="turn"/>',
            '<position name="m_turn" joint="turn"/>',
            "m_turn .* plain motor: .*bias",
        ),
        ('name="m_turn"', 'name="m_turn" gear="100"', "m_turn is not a plain motor: its gear is 100; write <motor"),
        ('name="m_turn" joint="turn"', 'name="m_turn" site="attachment_site"', "other than a joint"),
        (
            '<motor name="m_turn" joint="turn"/>',
            '<general name="m_turn" joint="turn" gainprm="5"/>',
            "m_turn is not a plain motor: its gain is 5",
        ),
        (
            '<motor name="m_turn" joint="turn"/>',
            '<general name="m_turn" joint="turn" gaintype="affine"/>',
            "its gain is not fixed",
        ),
        (
            '<motor name="m_turn" joint="turn"/>',
            '<general name="m_turn" joint="turn" dyntype="filter" dynprm="0.1"/>',
            "activation dynamics",
        ),
        ('name="m_turn"', 'name="m_turn" nsample="5" delay="0.01"', "it has a delay"),
        ('name="m_turn"', 'name="m_turn" damping="1"', "it has damping"),
        ('name="m_turn"', 'name="m_turn" armature="1"', "it has armature"),
        ('ctrlrange="-20 20"', 'ctrlrange="-10 20"', "bend has torque range -10 to 20; give it as -limit to limit"),
        ('actuatorfrcrange="-5 5"', 'actuatorfrcrange="-5 6"', "bend has torque range -5 to 6"),
    ],
)
def test_what_is_not_an_arm_is_refused(foreign: str, old: str, new: str, message: str) -> None:
    assert old in FOREIGN
    Path(foreign).write_text(FOREIGN.replace(old, new, 1))
    with pytest.raises(ModelError, match=message) as info:
        load_model(foreign)
    assert "\n" not in str(info.value)
    assert foreign in str(info.value)


def test_motors_out_of_order_are_refused(foreign: str) -> None:
    lines = FOREIGN.splitlines()
    i = next(i for i, line in enumerate(lines) if "m_turn" in line)
    lines[i], lines[i + 1] = lines[i + 1], lines[i]
    Path(foreign).write_text("\n".join(lines))
    with pytest.raises(ModelError, match=r"drive push, turn, bend in this order; .* chain: turn, push, bend"):
        load_model(foreign)


def test_jointless_model_is_refused(foreign: str) -> None:
    Path(foreign).write_text("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
    with pytest.raises(ModelError, match="no joint; an arm needs at least one"):
        load_model(foreign)


def test_tool_site_must_ride_on_the_last_link(foreign: str) -> None:
    Path(foreign).write_text(FOREIGN.replace('<body name="spacer"', '<site name="tcp"/><body name="spacer"'))
    with pytest.raises(ModelError, match=r"tool frame is on arm1, .* put a site named tcp on arm3"):
        chain_of(load_model(foreign))


def test_missing_file_lists_the_choices(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"'ur5.xml': no such file \(.*ur5.xml\); give lwa4d_7dof, .* or the path"):
        load_model("ur5.xml", base=tmp_path)


@pytest.mark.parametrize(
    ("edits", "message"),
    [
        (ArmEdits(mass_scale=(1.0, 2.0)), "mass_scale has 2 values for 3 joints; give one number or 3"),
        (ArmEdits(armature=(1.0,) * 7), "armature has 7 values for 3 joints"),
        (ArmEdits(friction=Friction(coulomb=(1.0,))), "friction.coulomb has 1 values for 3 joints"),
        (ArmEdits(armature="lwa4d"), "armature: lwa4d is known for lwa4d_7dof, .* only; give numbers"),
        (ArmEdits(friction="lwa4d"), "friction.viscous: lwa4d is known for"),
        (ArmEdits(payload=Payload(mass=1, inertia=(10, 1, 1))), "inertia must satisfy A"),
    ],
)
def test_edits_that_do_not_fit_are_refused(foreign: str, edits: ArmEdits, message: str) -> None:
    with pytest.raises(ModelError, match=message):
        load_model(foreign, edits)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"timestep": 0.0}, "timestep is 0.0 s; it must be positive"),
        ({"integrator": "rk4"}, "no integrator 'rk4'; give one of Euler, RK4, implicit"),
    ],
)
def test_bad_options_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ModelError, match=message):
        load_model("lwa4d_3dof", **options)


def test_edits_are_a_schema() -> None:
    schema = TypeAdapter(ArmEdits)
    read = schema.validate_python(
        {
            "payload": {"mass": 2, "com": [0, 0, 0.1]},
            "mass_scale": [1, 1.1, 1],
            "armature": "lwa4d",
            "friction": {"viscous": [1, 2, 3]},
            "gravity": [0, 0, -1.62],
        }
    )
    assert read == ArmEdits(
        payload=Payload(mass=2, com=(0, 0, 0.1)),
        mass_scale=(1, 1.1, 1),
        armature="lwa4d",
        friction=Friction(viscous=(1, 2, 3)),
        gravity=(0, 0, -1.62),
    )
    wrongs: tuple[dict[str, Any], ...] = (
        {"payloads": {}},
        {"payload": {"mass": 1, "weight": 2}},
        {"payload": {"mass": -1}},
        {"mass_scale": 0},
        {"armature": "lwa4p"},
        {"friction": {"viscous": -1}},
        {"gravity": [0, 0, float("nan")]},
    )
    for wrong in wrongs:
        with pytest.raises(ValidationError):
            schema.validate_python(wrong)
