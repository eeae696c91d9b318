"""The transfer function T of (4c): Brax's model of the arm, stepped in closed loop under law (3) with soft contact.

Arrays keep candidates on their last axis, called the lanes and written B in shapes: what is done to a candidate is then
done to a row of neighbouring numbers, which is the form that XLA turns into fast code on a CPU.
"""
