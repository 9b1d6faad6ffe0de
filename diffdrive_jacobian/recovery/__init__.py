"""Recovery of bags that a crash, a full disk or a damaged file system has left incomplete."""

from diffdrive_jacobian.bags.files import NotABagError
from diffdrive_jacobian.recovery.recover import (
    NothingToSaveError,
    Recovery,
    RecoveryInterruptedError,
    UncheckedError,
    recover,
)

__all__ = [
    'NotABagError',
    'NothingToSaveError',
    'Recovery',
    'RecoveryInterruptedError',
    'UncheckedError',
    'recover',
]
