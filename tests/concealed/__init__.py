"""Rigs whose truth is not the plant file's: concealed physics with sealed answers.

Nothing here imports thermoctl. The truths are finite volumes solved by exponential time differencing (thermal rigs), a
split-step integrator with set-valued friction (motion rigs) and scipy's LSODA (tanks); clocks jitter, sensors have
coloured noise, steps, outliers and gaps. Cases are written in the public formats, answers apart.

    python -m tests.concealed.generate --out DIR --number N --seed S [--smoke] [--answers DIR]
"""
