"""The same equations in a dense form that uses nothing of the recursion, to test against.

formulation   accelerations and multipliers
loads         joint loads
friction      with friction in the joints
"""
