"""The study of whether guidance helps people: plan, trials, measures, questionnaires, statistics, figures, simulated operators."""
