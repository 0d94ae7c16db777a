"""Plants as users might write them, right and wrong: tests copy the file."""

from dataclasses import dataclass

import numpy as np

from trms_cli.models.model import Signal


@dataclass(frozen=True, kw_only=True)
class Rig:
    how: str = ""
    at: int = 0  #: sample at which it begins to misbehave

    def init(self, setup):
        if self.how == "init raises":
            raise OSError("no such card")
        if self.how == "init returns nothing":
            return None
        with open("samples.txt", "w") as file:
            file.write(str(setup.samples))
        return RigRun(self.how, self.at)


class RigRun:
    inputs = (Signal("u_v", "V", "main rotor"), Signal("u_h", "V", "tail rotor"))
    outputs = (Signal("alpha_v", "rad", "pitch"), Signal("alpha_h", "rad", "yaw"))
    states = ()
    state = np.zeros(0)
    first_command = np.zeros(2)
    input_limits = (np.full(2, -2.5), np.full(2, 2.5))

    def __init__(self, how, at):
        self._how, self._at, self._sample = how, at, 0
        self.noise_sd = {"alpha_v": 0.001, "alpha_h": 0.001}
        self.known_disturbances = {}
        if how == "list of limits":
            self.input_limits = [-2.5, 2.5]
        if how == "names":
            self.outputs = ("alpha_v", "alpha_h")
        if how == "noise":
            self.noise_sd = {"alpha_v": 0.001}
        if how == "command":
            self.first_command = [0.0, 0.0]
        if how == "state":
            self.state = None

    def connect(self):
        self._note("connect")

    def arm(self):
        self._note("arm")

    def disarm(self):
        self._note("disarm")

    def close(self, reason):
        self._note(f"close {reason}")

    def measure(self):
        y = np.array([-0.62, 0.0])
        if self._sample >= self._at:
            if self._how == "list":
                return y.tolist()
            if self._how == "none":
                return None
            if self._how == "length":
                return y[:1]
            if self._how == "text":
                return "level"
            if self._how == "whole":
                return np.array([0, 0])
            if self._how == "measure raises":
                return y / [][self._sample]
        return y

    def advance(self, command):
        self._note(" ".join(f"{value:.3f}" for value in command))
        if self._how == "advance raises" and self._sample >= self._at:
            raise RuntimeError("the cable is off")
        self._sample += 1

    def _note(self, words):
        with open("rig.txt", "a") as file:
            file.write(f"{words}\n")


@dataclass(frozen=True, kw_only=True)
class Unfinished:
    def init(self, setup):
        return UnfinishedRun()


class UnfinishedRun:
    inputs, outputs, states = RigRun.inputs, RigRun.outputs, ()
    first_command, input_limits, state = np.zeros(2), RigRun.input_limits, np.zeros(0)

    @property
    def noise_sd(self):
        return self.tachos

    def measure(self):
        return np.zeros(2)
