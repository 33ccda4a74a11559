"""CAN logs as text: candump, ASC, TRC, BUSMASTER."""
