"""Hostile inputs, generated with a seed: each must succeed or be refused in one sentence.

python -m tests.hostile --seed 0 --cases 3000
"""
