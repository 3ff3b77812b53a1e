#!/bin/sh
# The alert rules of ../../prometheus/alerts.yml as a PrometheusRule, so that they exist only once:
#   sh deploy/kubernetes/monitoring/apply-alerts.sh | kubectl apply -f -
set -eu
cat <<'END'
apiVersion: monitoring.coreos.com/v1
kind: PrometheusRule
metadata:
  name: tandem
  namespace: tandem
spec:
END
sed 's/^/  /' "$(dirname "$0")/../../prometheus/alerts.yml"
