"""Every error a user can cause, in one tree.

LwaError
├── ScenarioError (ValueError)    a scenario file or an override is wrong: says file, line, key, value, remedy
├── ModelError (ValueError)       an MJCF file is not a serial arm with one motor a joint
├── KinematicsError (ValueError)
│   ├── ReachError                the target lies outside the workspace
│   ├── SingularError             the target leaves a joint angle undefined
│   └── JointLimitError           every branch of the inverse breaks a joint limit
├── TrajectoryError (ValueError)  a motion that cannot be built from what was asked
├── RecordError (OSError)         a record cannot be written or read
├── BusError (OSError)            a bus, a node on it, or what it said, is not as it must be
├── SweepError (ValueError)       a sweep cannot go on: another sweep's folder, too many runs, a cluster that is gone
└── IdentificationError (ValueError)  data that are no recording, or do not tell what was asked of them
"""


class LwaError(Exception):
    """Base of all errors that lwa4d_sim raises on purpose."""


class ScenarioError(LwaError, ValueError):
    """A scenario (file, override or variant) is not valid.

    Args:
        message: what is wrong and what would be valid.
        key: dotted key it is about, when the raiser knows it better than the one who builds the block.
    """

    def __init__(self, message: str, key: str | None = None) -> None:
        super().__init__(message)
        self.key = key


class ModelError(LwaError, ValueError):
    """A model file cannot serve as an arm."""


class KinematicsError(LwaError, ValueError):
    """An inverse kinematics problem has no usable solution."""


class ReachError(KinematicsError):
    """The target lies outside the workspace."""


class SingularError(KinematicsError):
    """The target leaves a joint angle undefined."""


class JointLimitError(KinematicsError):
    """Every branch of the inverse breaks a joint limit."""


class TrajectoryError(LwaError, ValueError):
    """A motion cannot be built from what was asked."""


class RecordError(LwaError, OSError):
    """A record cannot be written or read."""


class BusError(LwaError, OSError):
    """A bus, a node on it, or what it said, is not as it must be."""


class SweepError(LwaError, ValueError):
    """A sweep cannot be started or cannot go on; what it has is kept."""


class IdentificationError(LwaError, ValueError):
    """Data cannot be read as a recording, or do not tell what was asked of them.

    Args:
        message: what is wrong and what would be valid.
        key: dotted key of a scenario that it is about.
    """

    def __init__(self, message: str, key: str | None = None) -> None:
        super().__init__(message)
        self.key = key
