"""The commands that grant a user what a steady tick asks of the system. Texts, and nothing else."""

from __future__ import annotations

HIGHEST_PRIORITY = 80  # of SCHED_FIFO that is asked for; the kernel's own threads may be above

_LIMITS = "/etc/security/limits.d/softfinger.conf"
_RULE = "/etc/udev/rules.d/99-softfinger.rules"
_LATENCY_RULE = 'KERNEL=="cpu_dma_latency", GROUP="dialout", MODE="0660"'

PRIORITY = f'echo "$USER - rtprio {HIGHEST_PRIORITY}" | sudo tee -a {_LIMITS}, then log in again'
MEMORY_LOCK = f'echo "$USER - memlock unlimited" | sudo tee -a {_LIMITS}, then log in again'
LATENCY = (
    f"echo '{_LATENCY_RULE}' | sudo tee -a {_RULE} && sudo udevadm control --reload "
    "&& sudo udevadm trigger /dev/cpu_dma_latency"
)
