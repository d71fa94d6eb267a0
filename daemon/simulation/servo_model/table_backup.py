"""The control table backup of an emulated servo, and nothing else."""

from __future__ import annotations

from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.simulation.servo_model.control_table import ControlTable


class TableBackup:
    """What the backup instruction kept of ``table``; outlives a reboot. ``held``: whether any."""

    def __init__(self, table: ControlTable) -> None:
        self.held = False
        self._table = table
        self._values: dict[int, int] = {}

    def store(self) -> None:
        """Keep EEPROM, and the RAM that the manual names."""
        table = self._table
        self._values = {
            item.address: table.get(item.address)
            for item in table.items
            if item.writable and (item.saved or item.backed_up)
        }
        self.held = True
        self.tell()

    def restore(self, saved: bool) -> None:
        """Bring EEPROM (``saved``) or RAM back."""
        for address, value in self._values.items():
            if self._table.at[address].saved == saved:
                self._table.set(address, value)

    def tell(self) -> None:
        """The register that says whether there is one."""
        self._table.set(reg.BACKUP_READY, 1)
