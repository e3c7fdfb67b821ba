"""Physics of a batch: MuJoCo's own C loop over rows, each row a pure function of its state and control.

Every call starts the solver from zero, so that nothing but the state carries over: not the neighbours, not the thread, not the past.
"""

from __future__ import annotations

import mujoco
import numpy as np
from mujoco import rollout

from wasp_cli.tasks.base import Floats

_STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS
_CONTROL = int(mujoco.mjtState.mjSTATE_CTRL)


class BatchPhysics:
    """One model stepped for many rows. A row's state is qpos and qvel (these models have no other)."""

    def __init__(self, model: mujoco.MjModel, threads: int = 1) -> None:
        if mujoco.mj_stateSize(model, _STATE) != 1 + model.nq + model.nv:
            raise ValueError("the model has state besides qpos and qvel")
        self.model = model
        self._data = [mujoco.MjData(model) for _ in range(threads)]
        self._rollout = rollout.Rollout(nthread=threads if threads > 1 else 0)

    def advance(self, qpos: Floats, qvel: Floats, control: Floats, steps: int) -> tuple[Floats, Floats]:
        """States after `steps` physics steps under a held control: [n, nq], [n, nv], [n, nu] -> [n, nq], [n, nv]."""
        if len(qpos) == 1:
            data = self._placed(qpos, qvel, control)
            mujoco.mj_step(self.model, data, nstep=steps)
            return data.qpos[None].copy(), data.qvel[None].copy()
        state, _ = self._run(qpos, qvel, control, steps)
        nq = self.model.nq
        return state[:, -1, 1 : 1 + nq], state[:, -1, 1 + nq :]

    def sensors(self, qpos: Floats, qvel: Floats, control: Floats) -> Floats:
        """Sensor readings [n, nsensordata] at these very states."""
        if len(qpos) == 1:
            data = self._placed(qpos, qvel, control)
            mujoco.mj_forward(self.model, data)
            return np.array(data.sensordata[None])
        # A step reads its sensors before it integrates, so one more step tells those of the state it starts from.
        return self._run(qpos, qvel, control, 1)[1][:, 0]

    def _placed(self, qpos: Floats, qvel: Floats, control: Floats) -> mujoco.MjData:
        """The state of a single row: the same numbers as in a batch, without the batch's overhead."""
        data = self._data[0]
        data.qpos[:], data.qvel[:], data.ctrl[:] = qpos[0], qvel[0], control[0]
        data.qacc_warmstart[:] = 0.0
        data.time = 0.0
        return data

    def _run(self, qpos: Floats, qvel: Floats, control: Floats, steps: int) -> tuple[Floats, Floats]:
        model, rows = self.model, len(qpos)
        start = np.concatenate([np.zeros((rows, 1)), qpos, qvel], axis=1)
        held = np.repeat(control[:, None, :], steps, axis=1)
        state = np.empty((rows, steps, start.shape[1]))
        sensordata = np.empty((rows, steps, model.nsensordata))
        if rows:
            self._rollout.rollout(
                [model] * rows,
                self._data,
                start,
                held,
                control_spec=_CONTROL,
                skip_checks=True,
                nstep=steps,
                initial_warmstart=np.zeros((rows, model.nv)),
                state=state,
                sensordata=sensordata,
            )
        return state, sensordata
