"""Blind exam of a diagnosis: sealed cases, answers without a way to the labels, metrics.

case_distribution  kinds, effects, joints, sizes of cases; the protocol of a plant family
generate           plans and recordings of reference and field
dataset            cases on disk, labels, seal
run_cases          one process a case
score              one answer against one label
metrics            rates with intervals, calibration, confusion
report             table, figures, ledger
oracle             share of the gap that the true effects close
baselines, residual_forest   candidates to compare with
calibration        penalties and probabilities from development exams
"""
