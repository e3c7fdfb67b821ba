"""People at the controls: `wasp drive`. A browser shows what the robot sees and sends keys; the
server has the clock and the record.
"""
