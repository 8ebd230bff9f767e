"""What is an AIRBOT Play on a CAN bus: its boards, OD motors, gripper, start-up and the face of its driver.

`arm` is the driver's face; below it `startup`, `protocol` (with `od_motor`, `boards`, `gripper`) and
`settings`. The bus, the Damiao motors and the control loop are in `robot_adapters.can`; a simulated arm and
what proves the driver in `robot_adapters.simulation`.
"""
