"""How true the shape of a reconstruction is: accuracy, completion and the figures that follow from them.

`truth` says what there is, `fusion` makes a mesh of depth pictures, `scores` compares any mesh with the truth. The
prediction is held against the whole scene, the truth that it should hold is what the task's camera can see of it.
"""
