"""Parts of which each is one file here, and no change to the package: models made of them train.

As parts they are toys. Each is made for a precision from the kernels' modules that ``load`` gives;
inside the package, where imports are relative, a part does without.
"""
