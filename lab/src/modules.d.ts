declare module "*.css" {
  const text: string;
  export default text;
}
declare module "worker:*" {
  const source: string;
  export default source;
}
declare module "*.wasm" {
  const base64: string;
  export default base64;
}
