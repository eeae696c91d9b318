"""The transfer function T of (4c): Brax's model of the arm, stepped in closed loop under law (3) with soft contact.

Arrays keep candidates on their last axis, called the lanes and written B in shapes: every operation on a candidate then
runs over a row of neighbouring numbers.
"""
